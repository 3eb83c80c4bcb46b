"""Poses of all views of a scene in nerfstudio's normalised world, from the source that the layout names.

Nothing here may import a data manager: nerfstudio loads this module while it is importing its own.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from nerfstudio.cameras import camera_utils
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.dataparsers.base_dataparser import DataParser, DataparserOutputs
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParser, ColmapDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import Nerfstudio, NerfstudioDataParserConfig
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from beags_plugin.data.dataset import ColmapModel, Poses, PoseTable, TransformsFile
from beags_plugin.data.files import existing_images, photo_names
from beags_plugin.data.transforms_file import read_transforms
from beags_plugin.plugin.views.cameras import concatenate_cameras
from beags_plugin.plugin.views.colmap_files import read_lens
from beags_plugin.system.errors import UserError
from beags_plugin.system.progress import say
from beags_plugin.system.reading.ply import read_ply_points

SPLITS = ("train", "val", "test")


@dataclass(frozen=True)
class Normalization:
    """Options that turn, centre and scale the world: the data parser's, of these names."""

    orientation_method: Literal["pca", "up", "vertical", "none"]
    center_method: Literal["poses", "focus", "none"]
    auto_scale_poses: bool
    scale_factor: float
    scene_scale: float


@dataclass
class PosedViews:
    """All views of a scene, sorted by name, before they are split.

    stems: of each view that of its file, that in the poses, and its path below the folder of all files. members: split
    name to indices of its views; None where the poses name no splits. outputs: of nerfstudio's parser, for the scene
    box, the transform and the seed points.
    """

    images: list[Path]
    stems: list[set[str]]
    cameras: Cameras
    members: dict[str, list[int]] | None
    outputs: DataparserOutputs


def read_poses(poses: Poses, root: Path, normalization: Normalization) -> PosedViews:
    """Read the views of a scene in ``root``; raises ``UserError`` if they cannot be read or there are none."""
    named: list[str] = []
    if isinstance(poses, PoseTable):
        file, parts = poses.file, [_table_outputs(poses, normalization)]
    else:
        if isinstance(poses, TransformsFile):
            file, (parser, named) = poses.file, _transforms_parser(poses, root, normalization)
        else:
            file, (parser, named) = poses.folder, _colmap_parser(poses, root, normalization)
        parts = [_delegate(parser, split, file) for split in named or ("train",)]
    if any(part.mask_filenames for part in parts):
        say("mask_path of transforms.json is not used: beags-data reads class maps only.")

    # A view may be in several named splits (val and test are often the same): keep it once.
    paths = [path for part in parts for path in part.image_filenames]
    index_of = {path: index for index, path in enumerate(paths)}
    named_as = sorted(index_of, key=lambda path: path.as_posix())
    if not named_as:
        raise UserError(f"{file} holds no images: give poses for at least two.")
    if len(named_as) < 2 and not named:
        raise UserError(f"{file} holds the pose of one image alone: give poses for at least two.")
    cameras = concatenate_cameras([part.cameras for part in parts])[torch.tensor([index_of[i] for i in named_as])]
    members = None
    if named:
        position = {path: index for index, path in enumerate(named_as)}
        members = {
            split: sorted(position[path] for path in part.image_filenames)
            for split, part in zip(named, parts, strict=True)
        }
    images = [path.absolute() for path in _files(named_as, poses)]
    names = zip(named_as, images, photo_names(images), strict=True)
    stems = [{name.stem, image.stem, whole} for name, image, whole in names]
    return PosedViews(images, stems, cameras, members, parts[0])


def _files(named: list[Path], poses: Poses) -> list[Path]:
    if isinstance(poses, TransformsFile) and poses.images is not None:
        return [poses.images / path.name for path in named]
    if isinstance(poses, ColmapModel):
        return existing_images(named, poses.images, poses.in_order)
    return named


class _Transforms(Nerfstudio):
    """nerfstudio's parser of transforms.json, reading .ply without open3d and a global k4, which it overlooks."""

    global_k4 = 0.0

    def _generate_dataparser_outputs(self, split: str = "train") -> DataparserOutputs:
        with CONSOLE.capture():  # it says of every split that the data name it
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


def _transforms_parser(poses: TransformsFile, root: Path, normalization: Normalization) -> tuple[DataParser, list[str]]:
    """Return nerfstudio's parser, and the splits that transforms.json names."""
    file = poses.file
    meta = read_transforms(file)
    parser = _Transforms(
        NerfstudioDataParserConfig(
            data=root if file.name == "transforms.json" else file,
            downscale_factor=1,  # ours happens while loading; None would open images to guess one
            train_split_fraction=1.0,  # all views; they are split later
            load_3D_points="ply_file_path" in meta,  # without the key nerfstudio would ask on the terminal
            **vars(normalization),
        )
    )
    parser.global_k4 = float(meta.get("k4", 0.0))
    return parser, [split for split in SPLITS if f"{split}_filenames" in meta]


def _colmap_parser(poses: ColmapModel, root: Path, normalization: Normalization) -> tuple[DataParser, list[str]]:
    """Return nerfstudio's COLMAP parser, and the splits named by ``<split>_list.txt``."""
    parser = ColmapDataParser(
        ColmapDataParserConfig(
            data=root,
            downscale_factor=1,
            eval_mode="fraction",
            train_split_fraction=1.0,
            images_path=poses.images,
            colmap_path=poses.folder,
            load_3D_points=False,  # read with the seed points of other layouts
            **vars(normalization),
        )
    )
    return parser, [split for split in SPLITS if (root / f"{split}_list.txt").is_file()]


def _delegate(parser: DataParser, split: str, file: Path) -> DataparserOutputs:
    """Read one split by nerfstudio's own parser; raises ``UserError`` for its failures."""
    try:
        return parser.get_dataparser_outputs(split)
    except UserError:
        raise
    except ZeroDivisionError as error:  # while the world is scaled by how far the cameras are apart
        raise UserError(f"the poses in {file} are all of one place: give photos from several places.") from error
    # nerfstudio asserts, and its readers let KeyError, struct.error and the like through
    except Exception as error:
        if poseless := re.match(r"Some filenames for split (\w+) were not found: .*?Path\('(.*?)'\)", str(error)):
            raise UserError(
                f"the split {poseless[1]} names {poseless[2]}, of which {file} has no pose: correct the name, or "
                "delete the split."
            ) from error
        reason = " ".join(str(error).split()) or type(error).__name__
        raise UserError(
            f"the poses in {file} cannot be read ({type(error).__name__}: {reason}): correct the file."
        ) from error


def _table_outputs(table: PoseTable, normalization: Normalization) -> DataparserOutputs:
    """Normalise poses that a layout has read as nerfstudio's parsers do it."""
    given = torch.eye(4).repeat(len(table.images), 1, 1)
    given[:, :3] = torch.from_numpy(table.camera_to_world)
    poses, transform = camera_utils.auto_orient_and_center_poses(
        given,
        method=normalization.orientation_method,
        center_method=normalization.center_method,
    )
    scale = normalization.scale_factor
    if normalization.auto_scale_poses:
        scale /= max(float(poses[:, :3, 3].abs().max()), 1e-12)
    poses[:, :3, 3] *= scale
    K, sizes = torch.from_numpy(table.K).float(), torch.from_numpy(table.sizes)
    lens = torch.zeros(6) if table.lens is None else read_lens(table.lens, sizes[0].tolist(), float(K[0, 0, 0]))
    cameras = Cameras(
        camera_to_worlds=poses[:, :3, :4],
        fx=K[:, 0, 0],
        fy=K[:, 1, 1],
        cx=K[:, 0, 2],
        cy=K[:, 1, 2],
        width=sizes[:, 0],
        height=sizes[:, 1],
        distortion_params=lens.expand(len(K), 6).clone(),
        camera_type=CameraType.PERSPECTIVE,
    )
    side = normalization.scene_scale
    return DataparserOutputs(
        image_filenames=list(table.images),
        cameras=cameras,
        scene_box=SceneBox(aabb=torch.tensor([[-side] * 3, [side] * 3])),
        dataparser_transform=transform,
        dataparser_scale=scale,
        metadata={},
    )
