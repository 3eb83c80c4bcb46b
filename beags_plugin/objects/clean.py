"""Clean objects of runs on disk: their masks and views decide which Gaussians belong to them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from beags_plugin.cleaning.clean import LeftOut, clean
from beags_plugin.core.select import select_class
from beags_plugin.core.surfels import Surfels
from beags_plugin.labels.class_ids import BACKGROUND
from beags_plugin.objects.shown import Shown
from beags_plugin.runs.belonging import Belonging
from beags_plugin.runs.layout import PREPARED
from beags_plugin.runs.run import Run


@dataclass(frozen=True)
class Cleaner:
    """Decides once which Gaussians of a run's objects belong to them, and saves that in the run.

    shown: training views with masks. decided: the saved decisions.
    """

    shown: Shown
    decided: Belonging

    def clean(self, part: Surfels, index: Tensor, class_id: int) -> tuple[Surfels, Tensor, LeftOut]:
        """Return an object without Gaussians that do not belong to it; all of it if there are no masks.

        part: M Gaussians of class ``class_id``. index: [M] int64, their places in the scene. Returns the K that remain,
        in their order, [K] of ``index``, and how many were left out.
        """
        if (known := self.decided.known(class_id)) is not None:
            dropped, left_out = known
            keep = (~torch.isin(index, dropped)).nonzero()[:, 0]
            return part[keep], index[keep], left_out
        scene, doubt = self.shown.scene()
        if scene is None:
            return part, index, LeftOut(doubt=doubt)
        keep, left_out = clean(part, class_id, scene.views)
        self.decided.keep(class_id, index[~torch.isin(torch.arange(len(index)), keep)], left_out)
        return part[keep], index[keep], left_out


def cleaner_of(shown: Shown) -> Cleaner:
    """Return the cleaner of a run."""
    return Cleaner(shown, Belonging(shown.run.scene, shown.run.folder))


def decide(config_path: Path) -> None:
    """Decide for every object of a refined run which Gaussians belong to it, and save that in the run."""
    if not (config_path.parent / PREPARED / "grid.pt").exists():
        return
    run = Run(config_path)
    if not (scene := run.scene).assigned:
        return
    cleaner = cleaner_of(Shown(run))
    for class_id in scene.members.present():
        if class_id != BACKGROUND:
            cleaner.clean(*select_class(scene.surfels(), scene.members, class_id), class_id)
