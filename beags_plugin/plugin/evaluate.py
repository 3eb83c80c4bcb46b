"""Evaluation of runs on disk: their held-out views with ground truth, before and after refinement."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from beags_plugin.errors import UserError
from beags_plugin.evaluation.protocol import Protocol
from beags_plugin.evaluation.report import RunMetrics, Stage
from beags_plugin.evaluation.run_metrics import EvalView, SceneMetrics, evaluate_scene
from beags_plugin.masks.classes import read_class_map
from beags_plugin.plugin.extract import SavedScene, read_scene
from beags_plugin.plugin.runs import BASE_SNAPSHOT
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.rasterizers.interface import Rasterizer, RasterSettings

if TYPE_CHECKING:
    from beags_plugin.plugin.config import BeagsTrainerConfig

Progress = Callable[[int, int], None]


def evaluate_run(
    config_path: Path, protocol: Protocol | None = None, *, name: str = "", progress: Progress | None = None
) -> RunMetrics:
    """Score a trained run on the held-out views of its data, before refinement (if it has kept that) and after.

    config_path: config.yml of a run. protocol: the choices behind the figures. name: of the scene in tables; that of
    the data folder if empty. progress: is told (done, total) views. ``RunMetrics.to_json`` gives plain values.
    Raises ``UserError`` for a run, data or a protocol that cannot be used.
    """
    return EvaluatedRun(config_path, name).metrics(protocol, progress)


class EvaluatedRun:
    """A run on disk with its held-out views; everything is read when it is first asked for.

    name: of the scene in tables. stages: "before" and "after", or "after" alone, to the saved scenes.
    """

    def __init__(self, config_path: Path, name: str = "") -> None:
        self.config_path = Path(config_path)
        after = read_scene(self.config_path)
        snapshot = self.config_path.parent / BASE_SNAPSHOT / "config.yml"
        before = read_scene(snapshot) if snapshot.exists() and after.assigned else None
        self.stages: dict[Stage, SavedScene] = {"after": after}
        if before is not None and before.assigned:
            self.stages = {"before": before, "after": after}
        self.name = name or scene_name(after.config)
        self.classes = after.classes
        self.settings = raster_settings(after)
        self.rasterizer: Rasterizer = make_rasterizer(after.config.model_config.rasterizer)

    @cached_property
    def views(self) -> list[EvalView]:
        """The held-out views; raises ``UserError`` if the run's data cannot be read."""
        config = self.stages["after"].config
        try:
            return held_out_views(config, self.classes)
        except UserError as error:
            raise UserError(f"{self.config_path} names data that cannot be read: {error}") from error

    def metrics(self, protocol: Protocol | None = None, progress: Progress | None = None) -> RunMetrics:
        """The figures of all stages; arguments as of ``evaluate_run``."""
        protocol = protocol or Protocol()
        protocol.check()
        found: dict[Stage, SceneMetrics] = {}
        total = len(self.views) * len(self.stages)
        for stage, scene in self.stages.items():
            former = len(found) * len(self.views)
            found[stage] = evaluate_scene(
                scene.surfels(),
                scene.class_ids,
                self.rasterizer,
                self.settings,
                self.views,
                self.classes,
                protocol=protocol,
                progress=None if progress is None else lambda done, _, former=former: progress(former + done, total),
            )
        return RunMetrics(
            scene=self.name,
            config=str(self.config_path.absolute()),
            protocol=protocol,
            classes=self.classes,
            before=found.get("before"),
            after=found["after"],
            notes=self._notes(found["after"]),
        )

    def _notes(self, after: SceneMetrics) -> tuple[str, ...]:
        notes = []
        if not self.stages["after"].assigned:
            notes.append("This run has no classes (a base alone), so only images are scored.")
        elif not after.masks:
            notes.append("No held-out view has a mask, so only images are scored.")
        elif "before" not in self.stages:
            notes.append("This run has kept no state before refinement, so there is nothing to compare with.")
        return tuple(notes)


def scene_name(config: BeagsTrainerConfig) -> str:
    """The name of the run's data folder."""
    data = config.data_config.data or config.data_config.dataparser.data
    return Path(data).stem if Path(data).suffix == ".json" else Path(data).name


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


def _per_object(files: dict[str, list[Path | None]], classes: dict[int, str], view: int) -> dict[int, Tensor] | None:
    """Object id to its [h, w] bool mask in a view; None if there is none."""
    masks = {
        index: torch.from_numpy(read_class_map(path) > 0)
        for index, name in classes.items()
        if (path := files[name][view] if name in files else None) is not None
    }
    return masks or None
