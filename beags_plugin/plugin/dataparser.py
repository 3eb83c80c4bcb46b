"""Data parser ``beags-data``: nerfstudio or COLMAP poses, images, and id images of the classes.

Nothing here may import a data manager: nerfstudio loads this module while it is importing its own.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.dataparsers.base_dataparser import DataParser, DataParserConfig, DataparserOutputs
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParser, ColmapDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import Nerfstudio, NerfstudioDataParserConfig
from nerfstudio.plugins.registry_dataparser import DataParserSpecification
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from beags_plugin.errors import UserError
from beags_plugin.plugin import layout
from beags_plugin.plugin.cameras import (
    camera_from_nerfstudio,
    check_cameras,
    concatenate_cameras,
    downscaled_size,
    resize_cameras,
)
from beags_plugin.plugin.seed_points import random_points, read_ply_points


@dataclass
class BeagsDataParserConfig(DataParserConfig):
    """Options of ``beags-data``."""

    _target: type = field(default_factory=lambda: BeagsDataParser)
    data: Path = Path()
    """Folder of the scene, with transforms.json or COLMAP's sparse/0; or the transforms .json itself."""
    source: Literal["auto", "transforms", "colmap"] = "auto"
    """Where poses come from; auto prefers transforms.json."""
    images_path: Path | None = None
    """Folder of the images. COLMAP: "images" if not given. transforms.json: replaces the folder its file_path names.
    The images may be smaller than the poses say (images_4): the cameras follow the images."""
    masks_path: Path = Path("masks")
    """Folder of the id images <stem>.png; some or all may be missing."""
    classes_path: Path = Path("classes.json")
    """File {"id": "name"} of the classes; without it they are called class_<id>."""
    ground_truth_path: Path = Path("ground_truth")
    """Folder with exact masks for evaluation: masks/<stem>.png, silhouettes/<object>/<stem>.png; may be missing."""
    ignore_ids: tuple[int, ...] = ()
    """Ids in the masks that mean "not labelled"."""
    downscale_factor: float = 1.0
    """Divide the images' width and height by this when loading; nothing is written to disk."""
    eval_interval: int = 8
    """Every so many of the name-sorted views is held out for evaluation; 0: all views serve both.
    Splits that the data names itself (transforms.json, train_list.txt) come first."""
    held_out: tuple[str, ...] = ()
    """Stems of images to hold out for evaluation besides."""
    orientation_method: Literal["pca", "up", "vertical", "none"] = "up"
    """How the world is turned."""
    center_method: Literal["poses", "focus", "none"] = "poses"
    """How the world is centred."""
    auto_scale_poses: bool = True
    """Scale the world so that the cameras fit in +/- 1."""
    scale_factor: float = 1.0
    """Scale the world by this besides."""
    scene_scale: float = 1.0
    """Half the side of the scene box."""
    num_random_points: int = 50_000
    """Number of points to start from where the data brings none."""
    random_points_seed: int = 0
    """Seed of these points."""

    def __setattr__(self, name: str, value: object) -> None:
        """Keep ``data`` absolute, so that a saved config.yml works from any folder."""
        super().__setattr__(name, absolute(value) if name == "data" else value)


def absolute(path: object) -> object:
    """A given path as an absolute one; None and the empty path (not given) stay."""
    return Path(path).expanduser().absolute() if isinstance(path, (str, Path)) and Path(path) != Path() else path


class _Transforms(Nerfstudio):
    """nerfstudio's parser of transforms.json, reading .ply without open3d and a global k4, which it overlooks."""

    global_k4 = 0.0

    def _generate_dataparser_outputs(self, split: str = "train") -> DataparserOutputs:
        outputs = super()._generate_dataparser_outputs(split)
        parameters = outputs.cameras.distortion_params
        if self.global_k4 != 0.0 and parameters is not None:
            k4 = torch.full_like(parameters[..., :1], self.global_k4)
            outputs.cameras.distortion_params = torch.cat([parameters[..., :3], k4, parameters[..., 4:]], -1)
        return outputs

    def _load_3D_points(self, ply_file_path: Path, transform_matrix: Tensor, scale_factor: float) -> dict | None:
        points, colors = read_ply_points(ply_file_path)
        if len(points) == 0:
            return None
        moved = torch.from_numpy(points) @ transform_matrix[:, :3].T + transform_matrix[:, 3]
        return {"points3D_xyz": moved * scale_factor, "points3D_rgb": torch.from_numpy(colors)}


@dataclass
class _Scene:
    """All views of a scene, sorted by name, before they are split.

    members: split name to indices of its views, where the data names splits itself; else None.
    """

    images: list[Path]
    cameras: Cameras
    members: dict[str, list[int]] | None
    outputs: DataparserOutputs


class BeagsDataParser(DataParser):
    """Parser behind ``beags-data``; see ``BeagsDataParserConfig`` for its options.

    Metadata of what it returns, per view of the split where it is a list: ``points3D_xyz`` [P, 3] float32 in the world
    of the cameras, ``points3D_rgb`` [P, 3] uint8, ``points3D_random`` bool, ``classes`` dict id -> name,
    ``class_map_filenames`` list of Path or None, ``ignore_ids``, ``ground_truth`` (see ``layout.find_ground_truth``).
    Every user's mistake is a ``UserError``.
    """

    config: BeagsDataParserConfig

    def __init__(self, config: BeagsDataParserConfig) -> None:
        super().__init__(config)
        self._scene: _Scene | None = None
        self._metadata: dict | None = None

    def _generate_dataparser_outputs(self, split: str = "train", **kwargs) -> DataparserOutputs:
        if self._scene is None:  # train and eval share one parser: the poses are read once
            scene = self._read_scene()
            self._metadata = self._read_metadata(scene)
            self._scene = scene
        scene = self._scene
        chosen = self._views_of_split(scene, split)
        metadata = dict(self._metadata or {})
        metadata["class_map_filenames"] = [metadata["class_map_filenames"][i] for i in chosen]
        metadata["ground_truth"] = _select_ground_truth(metadata["ground_truth"], chosen)
        return DataparserOutputs(
            image_filenames=[scene.images[i] for i in chosen],
            cameras=scene.cameras[torch.tensor(chosen)],
            scene_box=scene.outputs.scene_box,
            dataparser_transform=scene.outputs.dataparser_transform,
            dataparser_scale=scene.outputs.dataparser_scale,
            metadata=metadata,
        )

    def _read_scene(self) -> _Scene:
        config = self.config
        if not config.downscale_factor >= 1.0:
            raise UserError(f"downscale_factor is {config.downscale_factor}: give 1 (full size) or more.")
        root = Path(config.data).absolute()
        self._source = layout.find_source(root, config.source)
        parser, named = self._transforms_parser() if self._source.kind == "transforms" else self._colmap_parser()
        parts = [_delegate(parser, split, self._source.file) for split in named or ("train",)]

        # A view may be in several named splits (val and test are often the same): keep it once.
        paths = [self._image_path(path) for part in parts for path in part.image_filenames]
        index_of = {path: index for index, path in enumerate(paths)}
        images = sorted(index_of, key=lambda path: path.as_posix())
        if not images:
            raise UserError(f"{self._source.file} holds no images: give poses for at least two.")
        cameras = concatenate_cameras([part.cameras for part in parts])[torch.tensor([index_of[i] for i in images])]
        members = None
        if named:
            position = {path: index for index, path in enumerate(images)}
            members = {
                split: sorted(position[self._image_path(path)] for path in part.image_filenames)
                for split, part in zip(named, parts, strict=True)
            }
        if any(part.mask_filenames for part in parts):
            CONSOLE.print("[yellow]mask_path of transforms.json is not used: beags-data reads class maps only.")
        check_cameras(cameras, images)
        return _Scene(images, cameras, members, parts[0])

    def _read_metadata(self, scene: _Scene) -> dict:
        """Checks of files against each other, and what all splits share."""
        config, root = self.config, self._source.root
        sizes = [layout.image_size(path) for path in scene.images]
        self._fit_cameras(scene, sizes)

        images_root = root / (config.images_path or "images")
        masks = layout.files_of_views(root / config.masks_path, scene.images, images_root)
        if not any(masks) and any((root / config.masks_path).glob("**/*.png")):
            raise UserError(
                f"no mask in {root / config.masks_path} has the name of an image ({scene.images[0].stem}.png, ...): "
                f"rename the masks, or give another masks_path."
            )
        layout.check_same_size(masks, sizes)
        present = [mask for mask in masks if mask is not None]
        classes = layout.read_class_names(root / config.classes_path, present, config.ignore_ids)

        points = {name: scene.outputs.metadata.get(name) for name in ("points3D_xyz", "points3D_rgb")}
        drawn = points["points3D_xyz"] is None or len(points["points3D_xyz"]) == 0
        if drawn:
            views = [camera_from_nerfstudio(scene.cameras, index) for index in range(len(scene.images))]
            xyz, rgb = random_points(views, config.num_random_points, config.random_points_seed)
            points = {"points3D_xyz": torch.from_numpy(xyz), "points3D_rgb": torch.from_numpy(rgb)}
        return {
            **points,
            "points3D_random": drawn,
            "classes": classes,
            "class_map_filenames": masks,
            "ignore_ids": tuple(config.ignore_ids),
            "ground_truth": layout.find_ground_truth(root / config.ground_truth_path, scene.images, images_root),
        }

    def _transforms_parser(self) -> tuple[DataParser, list[str]]:
        """nerfstudio's parser, and the splits that transforms.json names."""
        file = self._source.file
        try:
            meta = json.loads(file.read_text(encoding="utf-8"))
            frames = meta["frames"]
        except (ValueError, KeyError, TypeError) as error:
            raise UserError(f"{file} is not a nerfstudio transforms file: {error!r}.") from error
        if not frames:
            raise UserError(f"{file} names no frames: give poses for at least two images.")
        parser = _Transforms(
            NerfstudioDataParserConfig(
                data=self._source.root if file.name == "transforms.json" else file,
                downscale_factor=1,  # ours happens while loading; None would open images to guess one
                train_split_fraction=1.0,  # all views; they are split here
                load_3D_points="ply_file_path" in meta,  # without the key nerfstudio would ask on the terminal
                **self._shared_options(),
            )
        )
        parser.global_k4 = float(meta.get("k4", 0.0))
        return parser, [split for split in ("train", "val", "test") if f"{split}_filenames" in meta]

    def _colmap_parser(self) -> tuple[DataParser, list[str]]:
        """nerfstudio's COLMAP parser, and the splits named by ``<split>_list.txt``."""
        root, model = self._source.root, self._source.file
        parser = ColmapDataParser(
            ColmapDataParserConfig(
                data=root,
                downscale_factor=1,
                eval_mode="fraction",
                train_split_fraction=1.0,
                images_path=self.config.images_path or Path("images"),
                colmap_path=model.relative_to(root),
                load_3D_points=layout.has_points(model),
                **self._shared_options(),
            )
        )
        return parser, [split for split in ("train", "val", "test") if (root / f"{split}_list.txt").is_file()]

    def _shared_options(self) -> dict:
        names = ("orientation_method", "center_method", "auto_scale_poses", "scale_factor", "scene_scale")
        return {name: getattr(self.config, name) for name in names}

    def _image_path(self, path: Path) -> Path:
        if self._source.kind == "transforms" and self.config.images_path is not None:
            path = self._source.root / self.config.images_path / path.name
        return path.absolute()

    def _fit_cameras(self, scene: _Scene, sizes: Sequence[tuple[int, int]]) -> None:
        """Cameras of the size the images will have once loaded: that of the files, divided by the downscale factor."""
        cameras = scene.cameras
        camera_sizes = torch.cat([cameras.width, cameras.height], 1).tolist()
        for path, (width, height), (camera_width, camera_height) in zip(scene.images, sizes, camera_sizes, strict=True):
            # A smaller copy of the images rounds each side by up to a pixel; more is another picture.
            expected = width * camera_height / camera_width
            if abs(expected - height) > 1.0 + expected / width:
                raise UserError(
                    f"the image {path} is {width}x{height} pixels but its camera is {camera_width}x{camera_height}: "
                    f"use the images that the poses were made from."
                )
        actual = torch.tensor(sizes).to(torch.int64)
        size = downscaled_size(actual, self.config.downscale_factor)
        resize_cameras(cameras, size[:, :1], size[:, 1:])

    def _views_of_split(self, scene: _Scene, split: str) -> list[int]:
        if split not in ("train", "val", "test"):
            raise ValueError(f"unknown split {split!r}")
        if scene.members is not None:
            # nerfstudio asks for val while training and for test in ns-eval; data often names one of them
            for name in {"train": ("train",), "val": ("val", "test"), "test": ("test", "val")}[split]:
                if scene.members.get(name):
                    return scene.members[name]
            raise UserError(f"the data in {self._source.root} names splits but no views for {split}: name some.")
        train, held_out = layout.split_views(
            [path.stem for path in scene.images], self.config.eval_interval, self.config.held_out
        )
        return train if split == "train" else held_out


def _delegate(parser: DataParser, split: str, file: Path) -> DataparserOutputs:
    """What nerfstudio's own parser reads; its failures told in one sentence."""
    try:
        return parser.get_dataparser_outputs(split)
    except UserError:
        raise
    # nerfstudio asserts, and its readers let KeyError, struct.error and the like through
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise UserError(
            f"the poses in {file} cannot be read ({type(error).__name__}: {reason}): correct the file."
        ) from error


def _select_ground_truth(ground_truth: dict | None, chosen: Sequence[int]) -> dict | None:
    if ground_truth is None:
        return None
    selected: dict = {"masks": [ground_truth["masks"][i] for i in chosen]}
    for kind in ("silhouettes", "seen"):
        selected[kind] = {name: [files[i] for i in chosen] for name, files in ground_truth[kind].items()}
    return selected


beags_data = DataParserSpecification(
    config=BeagsDataParserConfig(),
    description="Scenes with class id images: nerfstudio transforms.json or COLMAP poses (BEA-GS).",
)
