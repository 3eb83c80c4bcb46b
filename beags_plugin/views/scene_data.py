"""The images, poses and masks of a scene in any registered layout."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from beags_plugin.data.dataset import Dataset, split_views
from beags_plugin.data.files import check_mask_files, check_same_size, files_of_views, image_size
from beags_plugin.data.ground_truth import find_ground_truth, of_views, stray_note
from beags_plugin.data.layout import read_dataset
from beags_plugin.data.orientation import sideways_photo_error
from beags_plugin.labels.classes import NO_TRUTH, read_class_names
from beags_plugin.system.errors import UserError
from beags_plugin.system.progress import say
from beags_plugin.views.cameras import SceneCameras, check_cameras, downscaled_size, resize_cameras
from beags_plugin.views.data_options import DataOptions
from beags_plugin.views.placing import Placing
from beags_plugin.views.poses import PosedViews, read_poses
from beags_plugin.views.recognised import images_root, recognised
from beags_plugin.views.seed_points import starting_points

if TYPE_CHECKING:
    from beags_plugin.views.tracks import Tracks

LEAST_PIXELS = 2  # least pixels of a side after scaling down


@dataclass(frozen=True)
class SplitData:
    """The V views of one split.

    metadata: ``points3D_xyz`` [P, 3] float32 in the world of the cameras, ``points3D_rgb`` [P, 3] uint8,
    ``points3D_random`` (whether the points are sampled), ``classes`` (id to name), ``mask_filenames`` (a path or None
    for each view), ``no_truth`` (the file ``labels.classes.NO_TRUTH``, or None),
    ``ignore_ids``, ``ground_truth`` (``data.ground_truth.GroundTruth`` or None), ``stray_truth`` (a sentence on exact
    masks of no view, or None).
    """

    images: list[Path]
    cameras: SceneCameras
    metadata: dict[str, Any]
    placing: Placing


class SceneData:
    """The scene that some options name, read when first used; all its methods raise ``UserError``.

    truth: whether to look for exact masks too, which only evaluation needs.
    """

    def __init__(self, config: DataOptions, truth: bool = True) -> None:
        self.config = config
        self._truth = truth
        self._views: PosedViews | None = None
        self._metadata: dict[str, Any] = {}

    def posed_views(self) -> tuple[Dataset, PosedViews]:
        """Read the scene and all its views; masks are not read."""
        config = self.config
        config.check()
        self._scene = scene = read_dataset(Path(config.data).absolute(), config.layout, config.images_path)
        views = read_poses(scene.poses, scene.root, config)
        check_cameras(views.cameras, views.images)
        return scene, views

    def tracks(self, split: str) -> Tracks:
        """Return the points that each view of a split shows, and where: of the COLMAP model, else seed points.

        Empty if no file tells. ``split`` must have been called before.
        """
        from beags_plugin.views.tracks import features_of, seeds_seen  # this imports OpenCV

        views = self._views
        assert views is not None
        tracks = features_of(self._scene, views)
        if not tracks and not self._metadata["points3D_random"]:
            tracks = seeds_seen(self._scene.root, self._metadata["points3D_xyz"].double().numpy(), views)
        return [tracks[view] for view in self.views_of_split(views, split)] if tracks else []

    def mask_files(self, scene: Dataset, views: PosedViews) -> tuple[list[Path | None], Path]:
        """Return the mask file of each view or None, and the folder of the masks."""
        folder = scene.root / (self.config.masks_path or scene.masks)
        return files_of_views(folder, views.images, images_root(scene)), folder

    def split(self, split: str) -> SplitData:
        """Return the views of "train", "val" or "test"; all splits share one reading of the poses."""
        if self._views is None:
            self._read()
        assert (views := self._views) is not None
        chosen = self.views_of_split(views, split)
        metadata = dict(self._metadata)
        metadata["mask_filenames"] = [metadata["mask_filenames"][i] for i in chosen]
        if metadata["ground_truth"] is not None:
            metadata["ground_truth"] = of_views(metadata["ground_truth"], chosen)
        images = [views.images[i] for i in chosen]
        return SplitData(images, views.cameras.chosen(torch.tensor(chosen)), metadata, views.placing)

    def _read(self) -> None:
        scene, views = self.posed_views()
        self._metadata = self._read_metadata(scene, views)
        for line in recognised(self, scene, views, self._metadata):
            say(line)
        self._views = views

    def _read_metadata(self, scene: Dataset, views: PosedViews) -> dict[str, Any]:
        """Check the files against each other, and return the metadata that all splits share."""
        config = self.config
        sizes = [image_size(path) for path in views.images]
        self.fit_cameras(views, sizes)
        masks, folder = self.mask_files(scene, views)
        if not any(masks):
            check_mask_files(folder, views.images)
        check_same_size(masks, sizes, views.images)
        present = [mask for mask in masks if mask is not None]
        truth = (scene.root / config.ground_truth_path, views.images, images_root(scene))
        classes_file = scene.root / config.classes_path
        self.check_folder(folder)
        if classes_file.is_dir() or not (config.classes_path == Path("classes.json") or classes_file.is_file()):
            raise UserError(f"the class names {classes_file} are no file: correct classes_path.")
        known = (scene.class_names, scene.class_names_file)
        return {
            **starting_points(scene, views, config.num_random_points),
            "classes": read_class_names(classes_file, present, config.ignore_ids, *known),
            "mask_filenames": masks,
            "no_truth": folder / NO_TRUTH if (folder / NO_TRUTH).exists() else None,
            "ignore_ids": tuple(config.ignore_ids),
            "ground_truth": find_ground_truth(scene, *truth) if self._truth else None,
            "stray_truth": stray_note(*truth) if self._truth else None,
        }

    def check_folder(self, masks: Path) -> None:
        """Raise ``UserError`` if the user has named a folder of masks that does not exist."""
        if self.config.masks_path is not None and not masks.is_dir():
            raise UserError(
                f"the folder of masks {masks} does not exist: correct masks_path; a relative one lies in the scene."
            )

    def fit_cameras(self, views: PosedViews, sizes: Sequence[tuple[int, int]]) -> None:
        """Resize the cameras in place to the loaded images: the files' sizes divided by the downscale factor."""
        cameras = views.cameras
        camera_sizes = torch.cat([cameras.width, cameras.height], 1).tolist()
        for path, (width, height), (camera_width, camera_height) in zip(views.images, sizes, camera_sizes, strict=True):
            # A smaller copy of an image rounds each side by up to a pixel; a larger difference means another image.
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
        """Return the indices of the views of "train", "val" or "test", without those that ``leave_out`` names."""
        wanted, left_out = self._with_left_out(views, split), set()
        for name in self.config.leave_out:
            found = {index for index, stems in enumerate(views.stems) if name in stems}
            if not found:
                raise UserError(
                    f"leave_out names {name}, but no image in {self._scene.root} is called that: correct it."
                )
            left_out |= found
        if left_out >= set(wanted):
            raise UserError(f"leave_out leaves no image for {split}: name fewer.")
        return [index for index in wanted if index not in left_out]

    def _with_left_out(self, views: PosedViews, split: str) -> list[int]:
        if split not in ("train", "val", "test"):
            raise ValueError(f"unknown split {split!r}")
        if views.members is not None:
            # nerfstudio uses val in training and test in ns-eval, but data often names only one of them.
            for name in {"train": ("train",), "val": ("val", "test"), "test": ("test", "val")}[split]:
                if views.members.get(name):
                    return views.members[name]
            where = self._scene.root
            raise UserError(f"the data in {where} names splits but no views for {split}: name some, or delete them.")
        config = self.config
        train, held_out = split_views(views.stems, self._scene.split, config.eval_interval, config.held_out)
        return train if split == "train" else held_out
