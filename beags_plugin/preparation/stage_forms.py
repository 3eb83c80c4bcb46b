"""How the results of the stages lie on disk: tensors and plain values."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import torch
from torch import Tensor

from beags_plugin.assignment.assignment import Assignment
from beags_plugin.core.densification import Densified
from beags_plugin.core.surfels import Surfels
from beags_plugin.labels.label_maps import LabelMaps, PackedMaps
from beags_plugin.occupancy.grid import VisibilityGrid
from beags_plugin.preparation.consistent_masks import ConsistentMasks
from beags_plugin.preparation.refiner import EditedScene
from beags_plugin.preparation.stages import Form


def _tensors(holder: Any) -> dict[str, Tensor]:
    """The fields of a dataclass of tensors, without what their storages hold besides."""
    return {field.name: getattr(holder, field.name).detach().cpu().clone() for field in fields(holder)}


def _compressed(image: Tensor) -> Tensor:
    """[H, W] uint8 or uint16 as the bytes of a PNG: maps of ids shrink to a hundredth."""
    import cv2

    return torch.from_numpy(cv2.imencode(".png", image.cpu().numpy())[1])


def _expanded(data: Tensor) -> Tensor:
    import cv2

    return torch.from_numpy(cv2.imdecode(data.numpy(), cv2.IMREAD_UNCHANGED))


def _pack_maps(maps: LabelMaps) -> list[Tensor]:
    images = (maps.narrow(index) for index in range(len(maps)))
    return [_compressed(image) for image in images if image is not None]  # every view has one by now


def _unpack_maps(packed: list[Tensor]) -> LabelMaps:
    return LabelMaps(_expanded(data) for data in packed)


def _pack_masks(masks: ConsistentMasks) -> dict[str, Any]:
    same, confidence = masks.labels is masks.ranked, masks.confidence
    return {
        "ranked": _pack_maps(masks.ranked),
        "labels": None if same else _pack_maps(masks.labels),
        "confidence": None if confidence is None else [_compressed(image) for image in confidence],
    }


def _unpack_masks(packed: dict[str, Any]) -> ConsistentMasks:
    ranked, confidence = _unpack_maps(packed["ranked"]), packed["confidence"]
    labels = ranked if packed["labels"] is None else _unpack_maps(packed["labels"])
    shares = None if confidence is None else PackedMaps(_expanded(data) for data in confidence)
    return ConsistentMasks(ranked, labels, shares)


def _pack_edited(scene: EditedScene) -> dict[str, Any]:
    edited = scene.edited
    return {
        "surfels": _tensors(edited.surfels),
        "source": edited.source,
        "fresh": edited.fresh,
        "assignment": _tensors(scene.assignment),
    }


def _unpack_edited(packed: dict[str, Any]) -> EditedScene:
    edited = Densified(Surfels(**packed["surfels"]), packed["source"], packed["fresh"])
    return EditedScene(edited, Assignment(**packed["assignment"]))


def _pack_bands(found: tuple[Surfels | None, float]) -> dict[str, Any]:
    surfels, change = found
    return {"surfels": None if surfels is None else _tensors(surfels), "change": change}


def _unpack_bands(packed: dict[str, Any]) -> tuple[Surfels | None, float]:
    return None if packed["surfels"] is None else Surfels(**packed["surfels"]), packed["change"]


MASKS = Form(_pack_masks, _unpack_masks)
ASSIGNMENT = Form(_tensors, lambda packed: Assignment(**packed))
EDITED = Form(_pack_edited, _unpack_edited)
BANDS = Form(_pack_bands, _unpack_bands)
"""The scene with fewer bands, None where all stay, and by how much that changes the views."""
GRID: Form[VisibilityGrid | None] = Form(
    lambda grid: None if grid is None else grid.state_dict(),
    lambda state: None if state is None else VisibilityGrid.from_state_dict(state),
)
