"""Evaluation of runs on disk on held-out views with ground truth, before and after refinement."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cached_property
from pathlib import Path

from torch import Tensor

from beags_plugin.core.membership import Membership
from beags_plugin.core.surfels import Surfels
from beags_plugin.evaluation.protocol import Protocol
from beags_plugin.evaluation.records import SceneMetrics
from beags_plugin.evaluation.report import RunMetrics, Stage
from beags_plugin.evaluation.run_metrics import evaluate_scene
from beags_plugin.evaluation.shown import shown_pixels
from beags_plugin.pictures.worst_views import WorstMask, draw_worst
from beags_plugin.rasterizers.rendering import fixed_background
from beags_plugin.runs.layout import BASE_SNAPSHOT, EXTRACTION_FILE
from beags_plugin.runs.read import SavedScene, read_run
from beags_plugin.runs.run import Run
from beags_plugin.runs.run_config import RunConfig
from beags_plugin.views.held_out_views import HeldOutViews

Progress = Callable[[int, int], None]

_PLAIN_NAMES = ("scene", "turned")  # folders of every beags demo


def evaluate_run(config_path: Path, protocol: Protocol | None = None) -> RunMetrics:
    """Score a trained run on the held-out views of its data, after refinement and, if it has saved that state, before.

    config_path: config.yml of a run. protocol: definitions of the metrics. Raises ``UserError`` for a run, data or a
    protocol that cannot be used.
    """
    return EvaluatedRun(config_path).metrics(protocol)


class EvaluatedRun:
    """A run on disk with its held-out views, which are read when first used.

    name: of the scene in tables. data: its folder if it has moved. stages: "before" and "after", or "after"
    alone, to the saved scenes. complete: False for a run of ``beags extract``, which holds a part of a scene.
    objects_alone: whether it was trained on the objects' pixels alone. colors_fitted: whether it has learned exposures
    of photos. classes: id to name of the classes that can be scored.
    """

    def __init__(self, config_path: Path, data: Path | None = None) -> None:
        self.config_path = Path(config_path)
        self.run = Run(self.config_path, data)
        after = self.run.scene
        self.stages: dict[Stage, SavedScene] = {"after": after}
        snapshot = self.config_path.parent / BASE_SNAPSHOT / "config.yml"
        if after.assigned and snapshot.exists() and (before := read_run(snapshot)).assigned:
            self.stages = {"before": before, "after": after}
        self.complete = not (self.config_path.parent / EXTRACTION_FILE).exists()
        self.objects_alone = after.config.data_config.photos == "objects"
        self.classes = after.classes
        if not self.complete:
            present = after.members.present()
            self.classes = {c: each for c, each in after.classes.items() if c in present}
        self.name = scene_name(after.config)
        self.colors_fitted = any(scene.exposures is not None for scene in self.stages.values())
        self.settings, self.rasterizer = self.run.settings, self.run.rasterizer

    @cached_property
    def views(self) -> HeldOutViews:
        """Return the held-out views; raise ``UserError`` if the run's data cannot be read."""
        return HeldOutViews(self.run.views("test"), self.classes, fixed_background(self.run.config.model_config))

    def shown(self) -> list[Tensor]:
        """Return the pixels of each held-out view that training photos show, by the depth of the first stage.

        All stages share these masks, so that their figures cover the same pixels.
        """
        first = next(iter(self.stages.values())).surfels()
        held_out, training = self.views.cameras("eval"), self.views.cameras("train")
        return shown_pixels(first, self.rasterizer, self.settings, held_out, training)

    def metrics(self, protocol: Protocol | None = None, progress: Progress | None = None) -> RunMetrics:
        """Return the figures of all stages. progress: receives (done, total) views."""
        protocol = protocol or Protocol()
        protocol.check()
        observed = self.shown() if self.complete and not self.objects_alone else None
        figures: dict[Stage, SceneMetrics] = {}
        total = len(self.views) * len(self.stages)
        for stage, scene in self.stages.items():
            former = len(figures) * len(self.views)
            figures[stage] = evaluate_scene(
                scene.surfels(),
                scene.members if scene.assigned else None,
                self.rasterizer,
                self.settings,
                self.views,
                self.classes,
                protocol=protocol,
                complete=self.complete,
                objects_alone=self.objects_alone,
                colors_fitted=self.colors_fitted,
                background=self.views.background,
                shown=observed,
                progress=None if progress is None else lambda done, _, former=former: progress(former + done, total),
            )
        return RunMetrics(
            scene=self.name,
            config=str(self.config_path.absolute()),
            protocol=protocol,
            classes=self.classes,
            before=figures.get("before"),
            after=figures["after"],
            notes=tuple(self._notes(figures["after"])),
        )

    def worst(self, metrics: RunMetrics, count: int, progress: Progress | None = None) -> list[WorstMask]:
        """Render the ``count`` worst masks of each kind. metrics: of this run. progress: receives (done, total)."""
        scenes: dict[Stage, tuple[Surfels, Membership]] = {
            stage: (scene.surfels(), scene.members) for stage, scene in self.stages.items() if scene.assigned
        }
        return draw_worst(metrics, scenes, self.views, self.rasterizer, self.settings, count, progress)

    def _notes(self, after: SceneMetrics) -> Iterator[str]:
        if not self.stages["after"].assigned:
            yield "This run has no classes (it is a base alone), so only images are scored."
        elif not after.masks and self.views.no_truth is not None:
            what = "nothing is" if self.objects_alone else "only images are"
            yield (
                f"A program drew the masks of held-out views, as {self.views.no_truth} says, so {what} scored: delete "
                "that file if they are right."
            )
        elif not after.masks and self.complete:
            yield "No held-out view has a mask, so only images are scored."
        elif not after.masks:
            yield "No held-out view has a mask of what this extracted run holds, so nothing is scored."
        elif not self.complete:
            yield "This run holds a part of a scene, so only objects drawn alone are scored."
        elif self.objects_alone:
            yield "This run was trained on the objects' pixels alone, so only these are scored."
        elif "before" not in self.stages:
            yield "This run has no saved state from before refinement, so there is nothing to compare with."
        if self.views.stray_truth is not None:
            yield self.views.stray_truth
        if trained_on := self.views.trained_on():
            yield f"{trained_on} of these {len(self.views)} views were trained on, so the figures flatter the run."


def scene_name(config: RunConfig) -> str:
    """Return the name of the folder of the run's data; that of its parent if it has one of ``_PLAIN_NAMES``."""
    folder = config.data_path.absolute()
    folder = folder.parent if folder.suffix == ".json" else folder
    return folder.parent.name if folder.name in _PLAIN_NAMES and folder.parent.name else folder.name
