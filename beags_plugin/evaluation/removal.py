"""Scores of scenes from which an object was removed, against an exact picture without it."""

from __future__ import annotations

import torch
from torch import Tensor

from beags_plugin.evaluation.metrics import RemovalMetrics, psnr
from beags_plugin.losses.photometric import ssim_map

TELLING = 0.1
"""Least distance between photo and exact picture, RGB in 0..1, at which a pixel tells whether the object remains.

If they are closer, ordinary rendering errors decide which of the two the rendering is nearer to."""


def removal_metrics(
    rendered: Tensor, photo: Tensor, exact: Tensor, silhouette: Tensor, known: Tensor | None = None
) -> RemovalMetrics:
    """Return PSNR and SSIM against the exact picture where the object was, and the share of the object that remains.

    rendered: [H, W, 3] float in 0..1, the scene without the object's Gaussians. photo, exact: the same view with and
    without the object. silhouette: [H, W] bool. known: [H, W] bool, pixels whose surface in the exact picture
    some training photo shows, or None. All metrics are over the silhouette; SSIM is the mean of its map, whose windows
    reach outside. The object remains in a pixel if the rendering is nearer to the photo than to the exact
    picture; only pixels where these two differ by ``TELLING`` or more count. A metric without pixels is None.
    """
    if not silhouette.any():
        return RemovalMetrics(None, None, None, None, None)
    similar = ssim_map(rendered, exact)[silhouette].mean()
    rendered, photo, exact = rendered[silhouette], photo[silhouette], exact[silhouette]
    telling = (photo - exact).norm(dim=-1) >= TELLING
    remains = ((rendered - photo).norm(dim=-1) < (rendered - exact).norm(dim=-1))[telling]
    shown = torch.zeros_like(telling) if known is None else known[silhouette]
    return RemovalMetrics(
        psnr(rendered, exact),
        psnr(rendered[shown], exact[shown]) if shown.any() else None,
        None if known is None else float(shown.double().mean()),
        float(similar),
        float(remains.double().mean()) if len(remains) else None,
    )
