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
    truth = manager.eval_dataset.metadata["ground_truth"] or {"masks": None, "silhouettes": {}, "seen": {}}
    views = []
    for index, view in enumerate(manager.views("test")):
        visible = view.labels
        if truth["masks"] and (exact := truth["masks"][index]) is not None:
            visible = torch.from_numpy(read_class_map(exact).astype(np.int32))
        silhouettes, seen = (_per_object(truth[kind], classes, index) for kind in ("silhouettes", "seen"))
        views.append(EvalView(view.camera, view.image, visible, silhouettes, view.name, seen))
    return views


def _per_object(
    files: dict[str, list[Path | None]], classes: dict[int, str], view: int
) -> dict[int, torch.Tensor] | None:
    """Object id to its [h, w] bool mask in a view; None if there is none."""
    masks = {
        index: torch.from_numpy(read_class_map(path) > 0)
        for index, name in classes.items()
        if (path := files[name][view] if name in files else None) is not None
    }
    return masks or None
