"""Veils: Gaussians before the cameras of photos that training did not see, which hide the objects there."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch

from beags_plugin.core.cameras import Camera
from beags_plugin.core.membership import Membership
from beags_plugin.core.select import select_class
from beags_plugin.core.surfels import Surfels
from beags_plugin.rasterizers.interface import Rasterizer, RasterSettings
from beags_plugin.rasterizers.rendering import geometry_inputs

VEILED = 0.1
"""Share of the objects' pixels that is hidden in a held-out photo, beyond the most in the training photos beside it."""
BESIDE = 6  # training photos, the nearest ones
HALF = 0.5  # alpha, and share of a pixel's light, from which a pixel belongs to an object


def veiled(
    surfels: Surfels,
    members: Membership,
    objects: Sequence[int],
    held_out: Mapping[str, Camera],
    training: Sequence[Camera],
    rasterizer: Rasterizer,
    settings: RasterSettings,
) -> list[str]:
    """Return the names of held-out photos in which something hides the objects that training photos beside them show.

    objects: their ids. held_out: name to camera. training: cameras of the training photos. It needs no ground truth:
    where an object drawn alone covers a pixel, the whole scene should give the pixel to an object. What stands before
    it hides it in one of the ``BESIDE`` nearest training photos too.
    """
    if not objects or not training:
        return []
    shares: dict[int, float] = {}

    def hidden(camera: Camera) -> float:
        return hidden_share(surfels, members, objects, camera, rasterizer, settings)

    def usual(view: int) -> float:
        if view not in shares:
            shares[view] = hidden(training[view])
        return shares[view]

    centers = torch.stack([camera.center for camera in training]).double()
    found = []
    for name, camera in held_out.items():
        if (share := hidden(camera)) > VEILED:
            nearest = (centers - camera.center.double()).norm(dim=1).argsort()[:BESIDE].tolist()
            most = max((each for view in nearest if not math.isnan(each := usual(view))), default=0.0)
            found += [name] if share > most + VEILED else []
    return found


@torch.no_grad()
def hidden_share(
    surfels: Surfels, members: Membership, objects: Sequence[int], camera: Camera, rasterizer: Rasterizer,
    settings: RasterSettings,
) -> float:  # fmt: skip
    """Return the share of the objects' pixels, each drawn alone, that the scene gives to no object; NaN without any.

    A pixel belongs to the objects, or to the rest, that more than half of its light comes from.
    """
    settings = replace(settings, geometry=False, distortion=False)
    whole, black = geometry_inputs(surfels), surfels.means.new_zeros(3)
    of_objects = torch.stack([members.of(class_id) for class_id in objects]).any(dim=0)
    colors = of_objects.to(whole.colors)[:, None].expand_as(whole.colors).contiguous()
    shown = rasterizer.rasterize(replace(whole, colors=colors), camera, settings, black).color[..., 0] > HALF
    pixels = lost = 0
    for class_id in objects:
        part = select_class(surfels, members, class_id)[0]
        if len(part):
            alone = rasterizer.rasterize(geometry_inputs(part), camera, settings, black).alpha > HALF
            pixels, lost = pixels + int(alone.sum()), lost + int((alone & ~shown).sum())
    return lost / pixels if pixels else float("nan")
