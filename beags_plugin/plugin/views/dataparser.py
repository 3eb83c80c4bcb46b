"""Data parser ``beags-data``: the images, poses and masks of a scene in any registered layout.

Nothing here may import a data manager: nerfstudio loads this module while it is importing its own.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import torch
from nerfstudio.data.dataparsers.base_dataparser import DataParser, DataParserConfig, DataparserOutputs
from nerfstudio.plugins.registry_dataparser import DataParserSpecification
from tyro.conf import Suppress

from beags_plugin.data.dataset import Dataset, MaskKind
from beags_plugin.data.files import check_mask_files, check_same_size, files_of_views, image_size
from beags_plugin.data.ground_truth import find_ground_truth, of_views, stray_note
from beags_plugin.data.labels import read_class_names
from beags_plugin.data.layout import read_dataset
from beags_plugin.data.orientation import sideways_photo_error
from beags_plugin.data.split import split_views
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.labels.classes import NO_TRUTH
from beags_plugin.plugin.views.cameras import check_cameras, downscaled_size, resize_cameras
from beags_plugin.plugin.views.ns_train import prepare
from beags_plugin.plugin.views.placing import Normalization, PlacedOutputs
from beags_plugin.plugin.views.poses import PosedViews, read_poses
from beags_plugin.plugin.views.recognised import images_root, recognised
from beags_plugin.plugin.views.seed_points import starting_points
from beags_plugin.system.errors import UserError, print_user_errors_plainly
from beags_plugin.system.progress import say

if TYPE_CHECKING:
    from beags_plugin.plugin.views.tracks import Tracks

LEAST_PIXELS = 2  # of a side that was scaled down; fewer show nothing


@dataclass
class BeagsDataParserConfig(DataParserConfig):
    """Options of ``beags-data``."""

    _target: type = field(default_factory=lambda: BeagsDataParser)
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
    orientation_method: Literal["pca", "up", "vertical", "none"] = "up"
    """How the world is turned."""
    center_method: Suppress[Literal["poses", "focus", "none"]] = "poses"
    """How the world is centred."""
    auto_scale_poses: Suppress[bool] = True
    """Scale the world so that the cameras fit in +/- 1."""
    scale_factor: Suppress[float] = 1.0
    """Scale the world by this besides."""
    scene_scale: Suppress[float] = 1.0
    """Half the side of the scene box."""
    num_random_points: Suppress[int] = 50_000
    """Number of points to start from where the data brings none."""
    strict: bool = False
    """Refuse data of which photos are missing, instead of going on without them."""

    def check(self) -> None:
        """Raise ``UserError`` for a value that nothing can be made of."""
        if self.downscale_factor is not None and not 1.0 <= self.downscale_factor < math.inf:
            raise UserError(f"downscale_factor is {self.downscale_factor}: give 1 (full size) or more.")
        for name in ("scale_factor", "scene_scale"):
            if not 0.0 < (value := getattr(self, name)) < math.inf:
                raise UserError(f"{name} is {value}: give a number above 0.")
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
    """Return a given path as an absolute one; None and the empty path (not given) stay."""
    return Path(path).expanduser().absolute() if isinstance(path, (str, Path)) and Path(path) != Path() else path


class BeagsDataParser(DataParser):
    """Parser behind ``beags-data``; every user error is a ``UserError``.

    Metadata of its outputs, per view of the split where it is a list: ``points3D_xyz`` [P, 3] float32 in the world
    of the cameras, ``points3D_rgb`` [P, 3] uint8, ``points3D_random`` bool, ``classes`` dict id -> name,
    ``mask_filenames`` list of Path or None, ``mask_kind`` (see ``data.dataset.MaskKind``), ``no_truth`` (the file that
    says so of the masks) or None, ``ignore_ids``, ``ground_truth`` (see ``data.ground_truth.GroundTruth``) or None,
    ``stray_truth`` (a sentence about exact masks of no view) or None.
    """

    config: BeagsDataParserConfig

    def __init__(self, config: BeagsDataParserConfig) -> None:
        print_user_errors_plainly()  # under other methods too
        super().__init__(config)
        self._views: PosedViews | None = None
        self._metadata: dict[str, Any] = {}

    def _generate_dataparser_outputs(self, split: str = "train", **kwargs) -> DataparserOutputs:
        if self._views is None:  # train and eval share one parser: the poses are read once
            self._read()
        assert (views := self._views) is not None
        chosen = self.views_of_split(views, split)
        metadata = dict(self._metadata)
        metadata["mask_filenames"] = [metadata["mask_filenames"][i] for i in chosen]
        if metadata["ground_truth"] is not None:
            metadata["ground_truth"] = of_views(metadata["ground_truth"], chosen)
        return PlacedOutputs(
            image_filenames=[views.images[i] for i in chosen],
            cameras=views.cameras[torch.tensor(chosen)],
            scene_box=views.scene_box,
            dataparser_transform=views.placing.original,
            dataparser_scale=views.placing.original_scale,
            metadata=metadata,
        )

    def posed_views(self) -> tuple[Dataset, PosedViews]:
        """Read the scene and all its views; masks are not read."""
        config = self.config
        config.check()
        self._scene = scene = read_dataset(Path(config.data).absolute(), config.layout, config.images_path)
        options = {name: getattr(config, name) for name in Normalization.__dataclass_fields__}
        views = read_poses(scene.poses, scene.root, Normalization(**options), config.strict)
        check_cameras(views.cameras, views.images)
        return scene, views

    def tracks(self, split: str) -> Tracks:
        """Return which points each view of a split shows, and where: of the COLMAP model, else seed points.

        Empty where nothing says so. The outputs of a split must have been asked for before.
        """
        from beags_plugin.plugin.views.tracks import features_of, seeds_seen  # they import OpenCV

        views = self._views
        assert views is not None
        found = features_of(self._scene, views)
        if not found and not self._metadata["points3D_random"]:
            found = seeds_seen(self._scene.root, self._metadata["points3D_xyz"].double().numpy(), views)
        return [found[view] for view in self.views_of_split(views, split)] if found else []

    def mask_files(self, scene: Dataset, views: PosedViews) -> tuple[list[Path | None], Path, MaskKind]:
        """Return the mask file of each view or None, the folder of the masks, and their kind."""
        folder, kind = scene.root / scene.masks, scene.mask_kind
        if self.config.masks_path is not None:
            folder, kind = scene.root / self.config.masks_path, "ids"
        elif scene.mask_files is not None:
            return [scene.mask_files.get(image.stem) for image in views.images], folder, kind
        return files_of_views(folder, views.images, images_root(scene)), folder, kind

    def _read(self) -> None:
        scene, views = self.posed_views()
        self._metadata = self._read_metadata(scene, views)
        for line in recognised(self, scene, views, self._metadata):
            say(line)
        self._views = views

    def _read_metadata(self, scene: Dataset, views: PosedViews) -> dict[str, Any]:
        """Check the files against each other and return the metadata that all splits share."""
        config = self.config
        sizes = [image_size(path) for path in views.images]
        self.fit_cameras(views, sizes)
        masks, folder, kind = self.mask_files(scene, views)
        if not any(masks):
            check_mask_files(folder, views.images)
        check_same_size(masks, sizes, views.images)
        present = [mask for mask in masks if mask is not None and kind == "ids"]
        truth = (scene.root / config.ground_truth_path, views.images, images_root(scene))
        classes_file = scene.root / config.classes_path
        self._check_named(folder, classes_file)
        known = (scene.class_names, scene.class_names_file)
        return {
            **starting_points(scene, views, config.num_random_points),
            "classes": read_class_names(classes_file, present, config.ignore_ids, *known),
            "mask_filenames": masks,
            "mask_kind": kind,
            "no_truth": folder / NO_TRUTH if (folder / NO_TRUTH).exists() else None,
            "ignore_ids": tuple(config.ignore_ids),
            "ground_truth": find_ground_truth(scene, *truth),
            "stray_truth": stray_note(*truth),
        }

    def _check_named(self, masks: Path, classes: Path) -> None:
        """Raise ``UserError`` where the user has named masks or classes that are not there."""
        if self.config.masks_path is not None and not masks.is_dir():
            raise UserError(f"the folder of masks {masks} does not exist: correct masks_path.")
        usual = self.config.classes_path == Path("classes.json")
        if classes.is_dir() or not (usual or classes.is_file()):
            raise UserError(f"the class names {classes} are no file: correct classes_path.")

    def fit_cameras(self, views: PosedViews, sizes: Sequence[tuple[int, int]]) -> None:
        """Resize the cameras in place to the loaded images: the files' sizes divided by the downscale factor."""
        cameras = views.cameras
        camera_sizes = torch.cat([cameras.width, cameras.height], 1).tolist()
        for path, (width, height), (camera_width, camera_height) in zip(views.images, sizes, camera_sizes, strict=True):
            # A smaller copy of the images rounds each side by up to a pixel; more is another picture.
            expected = width * camera_height / camera_width
            if abs(expected - height) > 1.0 + expected / width:
                if sentence := sideways_photo_error(path, (width, height), (camera_width, camera_height)):
                    raise UserError(sentence)
                raise UserError(
                    f"the image {path} is {width}x{height} pixels but its camera is {camera_width}x{camera_height}: "
                    f"use the images that the poses were made from."
                )
        actual = torch.tensor(sizes).to(torch.int64)
        factor = self._scene.downscale if self.config.downscale_factor is None else self.config.downscale_factor
        size = downscaled_size(actual, factor)
        if int(size.min()) < LEAST_PIXELS <= int(actual.min()):
            raise UserError(
                f"downscale_factor is {factor:g}, which leaves {int(size.min())} pixels of "
                f"a side of {views.images[0]}: give less, so that {LEAST_PIXELS} or more are left."
            )
        resize_cameras(cameras, size[:, :1], size[:, 1:])

    def views_of_split(self, views: PosedViews, split: str) -> list[int]:
        """Return the indices of the views of "train", "val" or "test"."""
        if split not in ("train", "val", "test"):
            raise ValueError(f"unknown split {split!r}")
        if views.members is not None:
            # nerfstudio asks for val while training and for test in ns-eval; data often names one of them
            for name in {"train": ("train",), "val": ("val", "test"), "test": ("test", "val")}[split]:
                if views.members.get(name):
                    return views.members[name]
            where = self._scene.root
            raise UserError(f"the data in {where} names splits but no views for {split}: name some, or delete them.")
        config = self.config
        train, held_out = split_views(views.stems, self._scene.split, config.eval_interval, config.held_out)
        return train if split == "train" else held_out


def __getattr__(name: str) -> DataParserSpecification:
    """Return the target of nerfstudio's entry point, ``beags_data``, which the first program to ask for it prepares."""
    if name != "beags_data":
        raise AttributeError(name)
    prepare()
    return DataParserSpecification(
        config=BeagsDataParserConfig(),
        description="Scenes with class id images: nerfstudio, COLMAP, LLFF and other layouts (BEA-GS).",
    )
