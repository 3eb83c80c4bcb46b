"""Held-out views of a run with their ground truth, as the nerfstudio-free evaluation wants them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from beags_plugin.evaluation.run_metrics import EvalView
from beags_plugin.masks.classes import read_class_map
from beags_plugin.rasterizers.interface import RasterSettings

if TYPE_CHECKING:
    from beags_plugin.plugin.config import BeagsTrainerConfig
    from beags_plugin.plugin.extract import SavedScene


def raster_settings(scene: SavedScene) -> RasterSettings:
    """Depth range of a saved scene."""
    extent, model = float(scene.state["extent"]), scene.config.model_config
    return RasterSettings(model.near * extent, model.far * extent)


def held_out_views(config: BeagsTrainerConfig, classes: dict[int, str]) -> list[EvalView]:
    """The test views of the run's data, with exact masks and silhouettes where the data has ``ground_truth/``.

    Without it, the data's own masks of those views serve as visible masks.
    """
    manager = config.data_config.setup(device="cpu", test_mode="test", world_size=1, local_rank=0)
    parser = manager.dataparser.config
    folder = Path(parser.data) / parser.ground_truth_path
    views = []
    for view in manager.views("test"):
        exact = folder / "masks" / f"{view.name}.png"
        visible = view.labels
        if exact.exists():
            visible = torch.from_numpy(read_class_map(exact).astype(np.int32))
        silhouettes = _per_object(folder / "silhouettes", classes, view.name)
        seen = _per_object(folder / "seen", classes, view.name)
        views.append(EvalView(view.camera, view.image, visible, silhouettes, view.name, seen))
    return views


def _per_object(folder: Path, classes: dict[int, str], view: str) -> dict[int, torch.Tensor] | None:
    """Object id to the [h, w] bool mask ``<folder>/<object>/<view>.png``; None if there is none."""
    masks = {
        index: torch.from_numpy(read_class_map(path) > 0)
        for index, name in classes.items()
        if (path := folder / name / f"{view}.png").exists()
    }
    return masks or None
