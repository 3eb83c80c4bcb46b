"""Training on the objects' pixels alone, for turntables, where the objects move and the room stands."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from beags_plugin.labels.class_ids import BACKGROUND, IGNORE
from beags_plugin.rasterizers.interface import RasterOutputs


def objects_alone(batch: dict[str, Any]) -> dict[str, Any]:
    """Make all of a batch's photo transparent but its objects, and say which pixels they are.

    Adds ``inside`` [H, W] bool, the pixels of any object, and ``known`` [H, W] bool, those that are not IGNORE.
    """
    labels: Tensor = batch["labels"]
    known = labels != IGNORE
    inside = known & (labels != BACKGROUND)
    image, alpha = batch["image"] * inside[..., None], 255 * inside.byte()
    return {**batch, "image": image, "alpha": batch.get("alpha", alpha) & alpha, "inside": inside, "known": known}


def where_known(color: Tensor, image: Tensor, batch: dict[str, Any]) -> Tensor:
    """Return a rendering with the photo's own values where the batch knows nothing: no loss tells them apart."""
    return torch.where(batch["known"][..., None], color, image) if "known" in batch else color


def of_objects(render: RasterOutputs, image: Tensor, batch: dict[str, Any]) -> RasterOutputs:
    """Return what losses see of a rendering: colour where it is known, depth in the pixels of objects alone.

    All of it, unless the batch is one of ``objects_alone``. image: the photo [H, W, 3], its background filled in.
    """
    if "inside" not in batch:
        return render
    depth, distortion = (
        None if each is None else torch.where(batch["inside"], each, 0.0) for each in (render.depth, render.distortion)
    )
    return replace(render, color=where_known(render.color, image, batch), depth=depth, distortion=distortion)
