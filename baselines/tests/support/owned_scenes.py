"""The discs of ``run_folders`` as a refiner that owns its training sees them: its edits are made, its steps are not."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace

from run_folders import CLASSES, SETTINGS, discs, drawn_labels, ring_cameras

from beags_plugin.core.surfels import Surfels
from beags_plugin.labels.label_maps import LabelMaps
from beags_plugin.preparation.refiner import Refiner
from beags_plugin.preparation.refiner_training import Edit, OwnTraining, TrainedScene
from beags_plugin.rasterizers import make_rasterizer


class OwnedScene:
    """Some views of the discs, with their class maps unless ``labels`` replaces them, and the edits so far."""

    def __init__(self, views: int = 24, labels=None, steps: int = 12, surfels: Surfels | None = None) -> None:
        self.surfels = surfels or discs()[0]
        self.cameras = ring_cameras(views, 4)
        self.labels = LabelMaps(labels or map(drawn_labels, self.cameras))
        self.edits: list[Edit] = []
        self.scene = TrainedScene(
            lambda: self.surfels, lambda: discs()[1], self.cameras, self.labels, CLASSES, make_rasterizer("auto"),
            replace(SETTINGS, geometry=False), seed=0, steps=steps, base_steps=0, extent=3.0, scale=1.0,
            stage=lambda _: nullcontext(lambda *_: None),
        )  # fmt: skip

    def take(self, edit: Edit | None) -> None:
        if edit is not None:
            self.edits.append(edit)
            self.surfels = self.surfels if edit.edited is None else edit.edited.surfels

    def run(self, refiner: Refiner) -> OwnTraining:
        """Take all steps as a run does, but that none changes a parameter."""
        steps = refiner.steps(self.scene.steps, len(self.cameras), len(CLASSES) - 1)
        self.scene = replace(self.scene, steps=steps)
        own = refiner.own_training(self.scene)
        assert own is not None
        for step in range(steps):
            self.take(own.before_step(step))
            self.take(own.after_step(step))
        self.take(own.last_edit())
        return own
