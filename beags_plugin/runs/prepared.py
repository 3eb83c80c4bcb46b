"""Files of a prepared refinement: voxel grids, and masks before and after reprojection."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.labels.class_ids import resize_nearest
from beags_plugin.labels.classes import read_id_mask
from beags_plugin.occupancy.grid import VisibilityGrid
from beags_plugin.runs.layout import PREPARED
from beags_plugin.system.errors import UserError
from beags_plugin.system.reading.tensors import load_tensors
from beags_plugin.system.reading.text import load_json
from beags_plugin.views.scene_data import SceneData
from beags_plugin.views.views import unique_names

if TYPE_CHECKING:
    import numpy.typing as npt

    from beags_plugin.runs.run_config import RunConfig

PREPARATION_REPORT = "report.json"
_REMEDY = "restore it, or refine again from base/nerfstudio_models"


def read_grid(path: Path) -> VisibilityGrid | None:
    """Read the grid of a prepared refinement; None where the refiner needs none. Raises ``UserError`` if damaged."""
    try:
        state = load_tensors(path)
    except (OSError, ValueError) as error:
        cause = getattr(error, "strerror", None) or error
        raise UserError(f"the voxel grid {path} cannot be read ({cause}): {_REMEDY}.") from error
    if not isinstance(state, dict) or (state and not _is_grid(state)):
        raise UserError(f"the voxel grid {path} is damaged: {_REMEDY}.")
    return VisibilityGrid.from_state_dict(state) if state else None


def _is_grid(state: dict[str, Any]) -> bool:
    values = [state.get(name) for name in ("voxel_size", "origin", "num_classes", "keys", "classes")]
    if len(parts := [value for value in values if isinstance(value, Tensor)]) < len(values):
        return False
    size, origin, count, keys, classes = parts
    return (
        (size.numel(), count.numel(), *origin.shape) == (1, 1, 3)
        and size.is_floating_point()
        and 0 < float(size) < math.inf
        and (count.dtype, keys.dtype, classes.dtype) == (torch.int64, torch.int64, torch.int32)
        and (keys.dim(), classes.shape) == (1, keys.shape)
    )


def photos_contradict(run: Path) -> bool:
    """Return whether a run's report says that its photos contradict each other outside the masks, as on a turntable."""
    path = run / PREPARED / PREPARATION_REPORT
    return path.exists() and bool(load_json(path).get("residuals", {}).get("contradict", False))


def dropped_background(folder: Path) -> bool:
    """Return whether the report of a preparation says that its grid was kept without voxels of the background."""
    path = folder / PREPARATION_REPORT
    return path.exists() and load_json(path).get("background_voxels") is False


def prepared_labels(path: Path, camera: Camera) -> Tensor:
    """Read the labels [H, W] int32 of a prepared mask; raises ``UserError`` if it does not fit the camera."""
    if not path.is_file():
        raise UserError(f"the prepared mask {path} is missing: {_REMEDY}.")
    labels = torch.from_numpy(read_id_mask(path).astype(np.int32))
    if labels.shape != (camera.height, camera.width):
        raise UserError(
            f"the prepared mask {path} is {labels.shape[1]}x{labels.shape[0]} pixels but its view is "
            f"{camera.width}x{camera.height}: restore the data, or refine again from base/nerfstudio_models."
        )
    return labels


@dataclass(frozen=True)
class TrainingMasks:
    """The masks of one training view, all [h, w] uint16 class ids or IGNORE, at the size of the training images.

    photo: the image file. given: the data's mask, or None. used: the mask after reprojection. exact: the ground truth,
    or None. confidence: file of the winner's share of the votes; it may be missing.
    """

    name: str
    photo: Path
    given: npt.NDArray[np.uint16] | None
    used: npt.NDArray[np.uint16]
    exact: npt.NDArray[np.uint16] | None
    confidence: Path


def training_masks(config: RunConfig) -> list[TrainingMasks]:
    """Read the masks of every training view of a run that refined; lens distortion is not removed."""
    outputs = SceneData(replace(config.data_config.dataparser, data=config.data_path)).split("train")
    metadata = outputs.metadata
    exact = (metadata["ground_truth"] or {}).get("masks") or [None] * len(outputs.images)
    prepared = config.get_base_dir() / PREPARED
    views = []
    for index, (name, photo) in enumerate(zip(unique_names(outputs.images), outputs.images, strict=True)):
        used = read_id_mask(prepared / "masks" / f"{name}.png")

        def sized(path: Path | None, like: np.ndarray = used) -> np.ndarray | None:
            return None if path is None else resize_nearest(read_id_mask(path, metadata["ignore_ids"]), *like.shape)

        given = sized(metadata["mask_filenames"][index])
        confidence = prepared / "confidence" / f"{name}.png"
        views.append(TrainingMasks(name, photo, given, used, sized(exact[index]), confidence))
    return views
