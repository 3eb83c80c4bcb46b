"""Clean objects of runs on disk: their masks and views are asked which Gaussians belong."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from beags_plugin.cleaning.clean import LeftOut, clean
from beags_plugin.cleaning.silhouettes import MaskedViews
from beags_plugin.core.surfels import Surfels
from beags_plugin.labels.label_maps import LabelMaps
from beags_plugin.plugin.runs.layout import EXTRACTION_FILE, last_prepared, preparing_run
from beags_plugin.plugin.runs.prepared import prepared_labels
from beags_plugin.plugin.runs.read import SavedScene, data_of_run, raster_settings
from beags_plugin.plugin.views.cameras import camera_from_nerfstudio
from beags_plugin.plugin.views.views import unique_names
from beags_plugin.preparation.consistent_masks import render_depths
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.system.errors import UserError
from beags_plugin.system.filed_tensors import filed
from beags_plugin.system.progress import progress_bar

MOST_VIEWS = 100  # evenly chosen ones; more would tell little more, and take longer


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
    """Return the cleaner of a run, with its masks after reprojection and the cameras of its data.

    scene: read from ``config_path``. The depth of the whole scene is rendered once for each view, and kept on disk.
    """
    run = config_path.parent
    if (run / EXTRACTION_FILE).exists():
        return Cleaner(None, "the run is part of a scene, which does not show what hides it")
    folder = last_prepared(preparing_run(run))
    if not (folder / "grid.pt").exists():
        return Cleaner(None, "the run has kept no masks")
    try:
        manager = data_of_run(scene.config, config_path, split="val")
    except UserError:
        return Cleaner(None, "the run's data cannot be read (--data names their folder)")
    dataset = manager.train_dataset
    chosen = range(0, len(dataset), -(-len(dataset) // MOST_VIEWS))
    cameras = [camera_from_nerfstudio(dataset.cameras, index) for index in chosen]
    names = [unique_names(dataset.image_filenames)[index] for index in chosen]
    try:
        labels = LabelMaps(
            prepared_labels(folder / "masks" / f"{name}.png", camera)
            for name, camera in zip(names, cameras, strict=True)
        )
    except UserError:
        return Cleaner(None, "the masks that the run has kept do not fit its data")
    rasterizer, settings = make_rasterizer(scene.config.model_config.rasterizer), raster_settings(scene)
    with progress_bar("Rendering depth", passing=True) as progress:
        surfels = scene.surfels().detach()
        depths = filed(render_depths(surfels, cameras, rasterizer, settings, "median", progress), surfels.means.device)
    return Cleaner(MaskedViews(cameras, labels, depths, rasterizer, settings))
