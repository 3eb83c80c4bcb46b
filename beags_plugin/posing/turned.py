"""Detection of objects that turned before a room that stood still, for which the room's poses are wrong."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from beags_plugin.labels.class_ids import BACKGROUND, IGNORE
from beags_plugin.labels.classes import read_id_mask

FEW = 0.25  # ratio to the share around objects; 0.1 on a generated turntable, 0.56 and 3.9 on two still captures
LEAST = 200  # features inside objects that make their share reliable
TURN = 5.0  # degrees by which two models must differ in the turn between two photos, median of all pairs
ENOUGH = 0.75  # share of the photos with poses from the room, or of all, that must have poses from the objects alone
MORE = 2.0  # ratio to the share inside objects that the room's poses explain; 6 on the generated turntable


def shares_explained(photos: Iterable[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> tuple[float, float, int]:
    """Return the shares of features that have a 3D point, inside and around objects, and the number of features inside.

    photos: for each, positions of features [N, 2] in 0..1 (from the left, from the top), [N] bool whether each has a
    3D point, and class ids [H, W].
    """
    table = np.zeros((2, 2), np.int64)  # rows: inside, around; columns: with a point, all
    for places, known, ids in photos:
        height, width = ids.shape
        columns, rows = np.clip((places * [width, height]).astype(np.int64), 0, [width - 1, height - 1]).T
        label = ids[rows, columns]
        for row, chosen in enumerate(((label != BACKGROUND) & (label != IGNORE), label == BACKGROUND)):
            table[row] += known[chosen].sum(), chosen.sum()
    inside, around = table[:, 0] / np.maximum(table[:, 1], 1)
    return float(inside), float(around), int(table[0, 1])


def seem_turned(inside: float, around: float, count: int) -> bool:
    """Return whether so few features inside objects have points (``shares_explained``) that the objects moved."""
    return count >= LEAST and inside < FEW * around


def objects_seem_turned(model: Path, masks: Path) -> bool:
    """Return whether the objects in masks <photo>.png seem to have moved against the poses of a COLMAP model."""
    return seem_turned(*shares_explained(_features(_read(model), masks)))


def poses_are_their_own(objects: Path, room: Path, masks: Path) -> bool:
    """Return whether poses from the objects' features alone should replace poses from whole photos.

    They should if ``ENOUGH`` of the photos have them, if they turn differently from photo to photo (``TURN``), and if
    they give points to ``MORE`` times the share of features inside masks <photo>.png. objects, room: folders of COLMAP
    models.
    """
    models = [_read(folder) for folder in (objects, room)]
    turns: list[dict[str, np.ndarray]] = []
    for model in models:
        images = (model.images[image_id] for image_id in model.reg_image_ids())
        turns.append({image.name: image.cam_from_world().rotation.matrix() for image in images})
    names = sorted(turns[0].keys() & turns[1].keys())
    if len(names) < max(2, ENOUGH * len(turns[1])):
        return False
    # All of these are one rotation if both agree.
    between = np.array([turns[0][name].T @ turns[1][name] for name in names]).reshape(-1, 9)
    cosine = (between @ between.T - 1) / 2
    if np.median(cosine[np.triu_indices(len(names), 1)]) > np.cos(np.deg2rad(TURN)):
        return False
    own, others = (shares_explained(_features(model, masks))[0] for model in models)
    return own > MORE * others


def _read(model: Path) -> Any:
    import pycolmap

    return pycolmap.Reconstruction(model)


def _features(model: Any, masks: Path) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Yield the input of ``shares_explained`` for each photo of pycolmap's reconstruction that has a mask."""
    for image_id in model.reg_image_ids():
        image = model.images[image_id]
        camera, mask = model.cameras[image.camera_id], masks / f"{Path(image.name).stem}.png"
        if mask.is_file():
            places = np.array([point.xy for point in image.points2D]).reshape(-1, 2)
            known = np.array([point.has_point3D() for point in image.points2D], bool)
            yield places / [camera.width, camera.height], known, read_id_mask(mask)
