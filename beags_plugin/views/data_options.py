"""Options of the data: how a scene's files are read and split, and which parts training sees."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from tyro.conf import Suppress

from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.system.errors import UserError

STREAM_ABOVE = 0.5  # GB (10^9 bytes)


@dataclass
class DataOptions:
    """Options of ``beags-data``, the data parser, as commands on finished runs read them."""

    data: Path = Path()
    """Folder of the scene; or a transforms .json itself."""
    layout: str = "auto"
    """How the data set lays out its files: nerfstudio, colmap, llff, ... (docs/data.md); auto recognises it."""
    images_path: Path | None = None
    """Folder of the images, if not the layout's own. transforms.json: replaces the folder its file_path names.
    The images may be smaller than the poses say (images_4): the cameras follow the images."""
    masks_path: Path | None = None
    """Folder of the id images <stem>.png, if not the layout's own, mostly "masks"; some or all may be missing."""
    classes_path: Path = Path("classes.json")
    """File {"id": "name"} of the classes; without it they are called class_<id>."""
    ground_truth_path: Suppress[Path] = Path("ground_truth")
    """Folder with exact masks for evaluation: masks/<stem>.png, visible/<object>/<stem>.png,
    silhouettes/<object>/<stem>.png; may be missing."""
    ignore_ids: tuple[int, ...] = ()
    """Ids in the masks that mean "not labelled"."""
    downscale_factor: float | None = None
    """Divide the images' width and height by this when loading; nothing is written to disk. None: the layout's own,
    mostly 1 (docs/data.md)."""
    eval_interval: int = 8
    """Of the name-sorted views, one in this many is held out for evaluation; 0: all views serve both.
    Splits that the data or its protocol names come first."""
    held_out: tuple[str, ...] = ()
    """Stems of images to hold out for evaluation besides."""
    leave_out: tuple[str, ...] = ()
    """Stems of images that are not used at all, such as those with wrong poses."""
    orientation_method: Literal["pca", "up", "vertical", "none"] = "up"
    """How the world is turned."""
    center_method: Suppress[Literal["poses", "none"]] = "poses"
    """How the world is centred."""
    auto_scale_poses: Suppress[bool] = True
    """Scale the world so that the cameras fit in +/- 1."""
    scale_factor: Suppress[float] = 1.0
    """Scale the world by this besides."""
    num_random_points: Suppress[int] = 50_000
    """Number of points to start from where the data brings none."""
    strict: bool = False
    """Refuse data of which photos are missing, instead of going on without them."""

    def check(self) -> None:
        """Raise ``UserError`` for an unusable value."""
        if self.downscale_factor is not None and not 1.0 <= self.downscale_factor < math.inf:
            raise UserError(f"downscale_factor is {self.downscale_factor}: give 1 (full size) or more.")
        if not 0.0 < self.scale_factor < math.inf:
            raise UserError(f"scale_factor is {self.scale_factor}: give a number above 0.")
        if self.center_method not in ("poses", "none"):  # An older run may have another.
            raise UserError(
                f"center_method is {self.center_method!r}, which is gone: train again, or use the version that "
                "wrote the run."
            )
        if self.eval_interval < 0:
            raise UserError(f"eval_interval is {self.eval_interval}: give a number of views, or 0 to hold out none.")
        if self.num_random_points < 4:
            raise UserError(f"num_random_points is {self.num_random_points}: a scene starts from at least 4.")
        if wrong := [index for index in self.ignore_ids if not 0 <= index <= IGNORE]:
            raise UserError(f"ignore_ids holds {wrong[0]}: ids are whole numbers in 0..{IGNORE}.")

    def __setattr__(self, name: str, value: object) -> None:
        """Keep ``data`` absolute, so that a saved config.yml works from any folder."""
        super().__setattr__(name, absolute(value) if name == "data" else value)


def absolute(path: object) -> object:
    """Return a path made absolute; None and the empty path, which means none, stay."""
    return Path(path).expanduser().absolute() if isinstance(path, (str, Path)) and Path(path) != Path() else path


@dataclass
class ViewOptions:
    """Options of the data manager, as commands on finished runs read them."""

    stream: Literal["auto", "always", "never"] = "auto"
    """Whether images are read from disk when needed instead of being kept in memory, with the same results; auto: if
    those of a split would take more than half a GB."""
    dense_seeds: Literal["auto", "on", "off"] = "auto"
    """Whether a base begins with more seed points, on whose depth several photos agree; auto: where there are at most
    50 photos, of which features give few points. It takes one or two seconds a photo."""
    begins: Suppress[bool] = False  # whether a base begins with seed points; the pipeline sets it
    focus: str = "auto"
    """Share of the steps that see close-ups of objects, at up to the size of the photos' files, and not whole photos.
    off: none; auto: half, if masks cover less than 40 % of the photos with objects and photos are scaled down; a run
    that goes on with another sees some if that did."""
    photos: Literal["all", "objects"] = "all"
    """What training sees of the photos: all, or objects, their pixels alone before a random colour (turntables)."""

    def streams(self, gb: float) -> bool:
        """Return whether images of a split, ``gb`` GB (10^9 bytes) in memory, are read when needed instead."""
        return self.stream == "always" or (self.stream == "auto" and gb > STREAM_ABOVE)

    def __setattr__(self, name: str, value: object) -> None:
        """Keep ``data`` absolute, so that a saved config.yml works from any folder."""
        super().__setattr__(name, absolute(value) if name == "data" else value)


@dataclass
class RunViewOptions(ViewOptions):
    """Options of the data manager of a finished run, with nerfstudio's own that matter to it."""

    data: Path | None = None
    dataparser: DataOptions = field(default_factory=DataOptions)
    camera_res_scale_factor: float = 1.0
    cache_images_type: Literal["uint8", "float32"] = "uint8"
