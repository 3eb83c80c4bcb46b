"""Cameras of photos that were shrunk."""

from __future__ import annotations

from beags_plugin.core.cameras import Camera


def small_camera(camera: Camera, size: tuple[int, int]) -> Camera:
    """Return a camera whose image of ``size`` (width, height) covers that of ``camera`` from edge to edge.

    With pixel centres at + 0.5, x becomes x W' / W: focal length and principal point take that factor, each axis its
    own.
    """
    width, height = size
    host = camera.host
    factors = host.K.new_tensor([[width / host.width], [height / host.height], [1.0]])
    return Camera(host.viewmat, host.K * factors, width, height).to(camera.viewmat.device)
