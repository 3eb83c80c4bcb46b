"""Training views of a run on disk: masks, depth of the whole scene, photos."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from beags_plugin.cleaning.silhouettes import MaskedViews
from beags_plugin.core.exposure import Exposures
from beags_plugin.data.files import image_size
from beags_plugin.preparation.consistent_masks import render_depths
from beags_plugin.runs.layout import EXTRACTION_FILE, PREPARED, preparing_run
from beags_plugin.runs.prepared import prepared_labels
from beags_plugin.runs.run import Run
from beags_plugin.system.errors import UserError
from beags_plugin.system.filed_tensors import filed
from beags_plugin.system.progress import progress_bar
from beags_plugin.views.cameras import camera_from_nerfstudio
from beags_plugin.views.run_data import RunData
from beags_plugin.views.streaming import Lazy
from beags_plugin.views.views import View, unique_names

MOST_VIEWS = 100  # views, evenly spread; more add little information, and take longer


class Unshown(Exception):
    """The masks or views of a run are not available; the message is a clause that says why."""


@dataclass(frozen=True)
class ShownScene:
    """Training views of a run: at most ``MOST_VIEWS``.

    names: of the views. views: their cameras, masks after reprojection and depth, in the frame of the run. manager,
    chosen: the data that hold their photos, and which views these are. exposures: of the photos; None if all share one.
    """

    names: list[str]
    views: MaskedViews
    manager: RunData
    chosen: range
    exposures: Exposures | None = None

    @cached_property
    def photos(self) -> list[View]:
        """Return the views with their photos, which are read when first used."""
        every = self.manager.views("train")
        return [every[index] for index in self.chosen]


class Shown:
    """The ``ShownScene`` of a run, made when it is first used."""

    def __init__(self, run: Run) -> None:
        self.run = run

    @cached_property
    def _scene_or_doubt(self) -> ShownScene | str:
        try:
            return shown_scene(self.run)
        except Unshown as doubt:
            return str(doubt)

    def scene(self) -> tuple[ShownScene | None, str]:
        """Return the scene, or None and why it is not available."""
        scene = self._scene_or_doubt
        return (None, scene) if isinstance(scene, str) else (scene, "")


def shown_scene(run: Run) -> ShownScene:
    """Return what training views of a run show.

    The depth of the whole scene is rendered once for each view, and stored on disk. Raises ``Unshown`` for a run whose
    masks or data are not available.
    """
    scene = run.scene
    if (run.folder / EXTRACTION_FILE).exists():
        raise Unshown("the run is part of a scene, without the objects that may hide it")
    if scene.picked:
        raise Unshown("its objects were picked in the viewer, and the masks saved in the run are of others")
    folder = preparing_run(run.folder) / PREPARED
    if not (folder / "grid.pt").exists():
        raise Unshown("the run has no saved masks")
    try:
        manager = run.views("val")
    except UserError as error:
        raise Unshown("the run's data cannot be read (--data names their folder)") from error
    dataset = manager.train_dataset
    chosen = range(0, len(dataset), -(-len(dataset) // MOST_VIEWS))
    cameras = [camera_from_nerfstudio(dataset.cameras, index) for index in chosen]
    names = [unique_names(dataset.image_filenames)[index] for index in chosen]
    files = [folder / "masks" / f"{name}.png" for name in names]
    try:
        fit = all(
            image_size(file) == (camera.width, camera.height) for file, camera in zip(files, cameras, strict=True)
        )
    except UserError:
        fit = False
    if not fit:
        raise Unshown("the masks saved in the run do not fit its data")
    labels = Lazy(lambda index: prepared_labels(files[index], cameras[index]), len(files))
    rasterizer, settings = run.rasterizer, run.settings
    with progress_bar("Rendering depth", passing=True) as progress:
        surfels = scene.surfels().detach()
        depths = filed(render_depths(surfels, cameras, rasterizer, settings, "median", progress), surfels.means.device)
    return ShownScene(
        names, MaskedViews(cameras, labels, depths, rasterizer, settings), manager, chosen, scene.exposures
    )
