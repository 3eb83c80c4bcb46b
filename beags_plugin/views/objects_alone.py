"""Training on the objects' pixels alone, for turntables, where the objects turn and the room stays."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from beags_plugin.labels.class_ids import BACKGROUND, IGNORE
from beags_plugin.rasterizers.interface import RasterOutputs


def objects_alone(batch: dict[str, Any]) -> dict[str, Any]:
    """Make a batch's photo transparent except for its objects.

    Adds ``inside`` [H, W] bool, the pixels of any object, and ``known`` [H, W] bool, the pixels that are not IGNORE.
    """
    labels: Tensor = batch["labels"]
    known = labels != IGNORE
    inside = known & (labels != BACKGROUND)
    image, alpha = batch["image"] * inside[..., None], 255 * inside.byte()
    return {**batch, "image": image, "alpha": batch.get("alpha", alpha) & alpha, "inside": inside, "known": known}


def where_known(color: Tensor, image: Tensor, batch: dict[str, Any]) -> Tensor:
    """Return a rendering with the photo's values at unlabelled pixels, where losses are then zero."""
    return torch.where(batch["known"][..., None], color, image) if "known" in batch else color


def of_objects(render: RasterOutputs, image: Tensor, batch: dict[str, Any]) -> RasterOutputs:
    """Return the part of a rendering that losses see: colour at known pixels, depth at pixels of objects.

    It is the whole rendering for a batch that is not of ``objects_alone``. image: the photo [H, W, 3], its background
    filled in.
    """
    if "inside" not in batch:
        return render
    depth, distortion = (
        None if each is None else torch.where(batch["inside"], each, 0.0) for each in (render.depth, render.distortion)
    )
    return replace(render, color=where_known(render.color, image, batch), depth=depth, distortion=distortion)
