"""Clean objects of runs on disk: their masks and views are asked which Gaussians belong."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import torch
from torch import Tensor

from beags_plugin.cleaning.clean import LeftOut, clean
from beags_plugin.cleaning.silhouettes import MaskedViews
from beags_plugin.core.select import select_class
from beags_plugin.core.surfels import Surfels
from beags_plugin.labels.class_ids import BACKGROUND
from beags_plugin.objects.shown import Unshown, shown_scene
from beags_plugin.runs.belonging import Belonging
from beags_plugin.runs.layout import PREPARED
from beags_plugin.runs.run import Run


@dataclass(frozen=True)
class Cleaner:
    """What decides which Gaussians of a run's objects belong to them: once, after which the run has kept it.

    views: returns training views with masks, or None and the reason why they cannot be had. kept: what was decided.
    """

    views: Callable[[], tuple[MaskedViews | None, str]]
    kept: Belonging

    def clean(self, part: Surfels, index: Tensor, class_id: int) -> tuple[Surfels, Tensor, LeftOut]:
        """Return an object without what does not belong to it; all of it where no mask can be asked.

        part: M Gaussians of class ``class_id``. index: [M] int64, theirs in the scene. Returns the K that are kept, in
        their order, [K] of ``index``, and how many were left out.
        """
        if (known := self.kept.known(class_id)) is not None:
            dropped, left_out = known
            keep = (~torch.isin(index, dropped)).nonzero()[:, 0]
            return part[keep], index[keep], left_out
        views, doubt = self.views()
        if views is None:
            return part, index, LeftOut(doubt=doubt)
        keep, left_out = clean(part, class_id, views)
        self.kept.keep(class_id, index[~torch.isin(torch.arange(len(index)), keep)], left_out)
        return part[keep], index[keep], left_out


def cleaner_of(run: Run) -> Cleaner:
    """Return the cleaner of a run, with its masks after reprojection and the cameras of its data."""

    @lru_cache(None)
    def views() -> tuple[MaskedViews | None, str]:
        try:
            return shown_scene(run).views, ""
        except Unshown as doubt:
            return None, str(doubt)

    return Cleaner(views, Belonging(run.scene, run.folder))


def decide(config_path: Path) -> None:
    """Decide for every object of a refined run which Gaussians belong to it, and keep that in the run."""
    if not (config_path.parent / PREPARED / "grid.pt").exists():
        return
    run = Run(config_path)
    if not (scene := run.scene).assigned:
        return
    cleaner = cleaner_of(run)
    for class_id in scene.members.present():
        if class_id != BACKGROUND:
            cleaner.clean(*select_class(scene.surfels(), scene.members, class_id), class_id)
