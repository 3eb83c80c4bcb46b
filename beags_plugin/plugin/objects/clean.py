"""Clean objects of runs on disk: their masks and views are asked which Gaussians belong."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from beags_plugin.cleaning.clean import LeftOut, clean
from beags_plugin.cleaning.silhouettes import MaskedViews
from beags_plugin.core.surfels import Surfels
from beags_plugin.plugin.objects.shown import Unshown, shown_scene
from beags_plugin.plugin.runs.read import SavedScene


@dataclass(frozen=True)
class Cleaner:
    """What decides which Gaussians of a run's objects belong to them.

    views: training views with masks; None where they cannot be had, for the reason ``doubt``.
    """

    views: MaskedViews | None
    doubt: str = ""

    def clean(self, part: Surfels, index: Tensor, class_id: int) -> tuple[Surfels, Tensor, LeftOut]:
        """Return an object without what does not belong to it; all of it where no mask can be asked.

        part: M Gaussians of class ``class_id``. index: [M] int64, theirs in the scene. Returns the K that are kept, in
        their order, [K] of ``index``, and how many were left out.
        """
        if self.views is None:
            return part, index, LeftOut(doubt=self.doubt)
        keep, left_out = clean(part, class_id, self.views)
        return part[keep], index[keep], left_out


def cleaner_of(scene: SavedScene, config_path: Path) -> Cleaner:
    """Return the cleaner of a run, with its masks after reprojection and the cameras of its data."""
    try:
        return Cleaner(shown_scene(scene, config_path).views)
    except Unshown as doubt:
        return Cleaner(None, str(doubt))
