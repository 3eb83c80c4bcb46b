"""The poses of all views as in their source: transforms.json, a COLMAP model, or a layout's own table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from beags_plugin.data.dataset import ColmapModel, PoseTable, TransformsFile
from beags_plugin.data.files import image_size, list_images
from beags_plugin.data.frame_cameras import FrameCamera, frame_camera
from beags_plugin.data.photo_files import PhotoFinder, plain_name, without_suffix
from beags_plugin.data.transforms_file import read_transforms
from beags_plugin.system.errors import UserError
from beags_plugin.system.progress import say
from beags_plugin.system.reading.text import read_text, reason
from beags_plugin.views.colmap_files import colmap_cameras, read_lens
from beags_plugin.views.colmap_model import model_files, read_images, rotation_of

SPLITS = ("train", "val", "test")
OLD_APPLIED = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]])
"""The transform that old versions of ns-process-data applied to COLMAP's world without recording it."""
_COLMAP_APPLIED = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]])  # nerfstudio has -y up


@dataclass(frozen=True)
class SourceViews:
    """All V views that a source names, sorted by name.

    file: of the poses, for messages. names: with slashes. wanted: paths where the photos should be. images: their
    files, None for missing ones. camera_to_world: [V, 3, 4] float64, OpenGL axes. cameras: None for missing photos.
    members: split name to indices, or None. orientation, applied, applied_scale: see ``placing.place``. points: a .ply
    in the poses' world, or None. missing: photos of further poses that the layout has left out.
    """

    file: Path
    names: list[str]
    wanted: list[Path]
    images: Sequence[Path | None]
    camera_to_world: np.ndarray
    cameras: list[FrameCamera | None]
    members: dict[str, list[int]] | None = None
    orientation: str | None = None
    applied: np.ndarray | None = None
    applied_scale: float = 1.0
    points: Path | None = None
    missing: tuple[Path, ...] = ()


def read_source(poses: ColmapModel | TransformsFile | PoseTable, root: Path) -> SourceViews:
    """Read the views of a scene in ``root``; raise ``UserError`` for poses that cannot be read."""
    if isinstance(poses, PoseTable):
        return _of_table(poses)
    return _of_colmap(poses, root) if isinstance(poses, ColmapModel) else _of_transforms(poses, root)


def _of_transforms(poses: TransformsFile, root: Path) -> SourceViews:
    file = poses.file
    meta = read_transforms(file)
    folder = file.parent
    frames = sorted(meta["frames"], key=lambda frame: (folder / plain_name(frame["file_path"])).as_posix())
    given = [frame["file_path"] for frame in frames]
    names = [plain_name(name) for name in given]
    if poses.images is None:
        finder = PhotoFinder([folder, folder / "images"])
        wanted = [folder / name.removeprefix("/") for name in names]
        images = finder.find(given)
    else:
        finder = PhotoFinder([poses.images], loose_folders=True)
        wanted = [poses.images / PurePosixPath(name).name for name in names]
        images = finder.find([PurePosixPath(name).name for name in names])
        if not all(images):  # they may be in subfolders
            images = [image or other for image, other in zip(images, finder.find(names), strict=True)]
    if any("mask_path" in frame for frame in frames):
        say("mask_path of transforms.json is not used: beags-data reads class maps only.")
    matrices = np.array([np.array(frame["transform_matrix"], np.float64)[:3] for frame in frames])
    cameras = [
        None if image is None else frame_camera(file, name, meta, frame, lambda image=image: image_size(image))
        for name, frame, image in zip(given, frames, images, strict=True)
    ]
    applied = meta.get("applied_transform")
    if applied is None and file.name == "transforms.json" and (root / "colmap/sparse/0").exists():
        applied = OLD_APPLIED
    members = {
        split: _split(split, names, meta[f"{split}_filenames"], file, folder)
        for split in SPLITS
        if meta.get(f"{split}_filenames") is not None
    }
    points = None
    if (named := meta.get("ply_file_path")) is not None:
        exact, near = PhotoFinder([folder]).exact(named), PhotoFinder([folder]).near(named)
        points = exact or near or folder / named
    return SourceViews(
        file, names, wanted, images, matrices, cameras, members or None, meta.get("orientation_override"),
        None if applied is None else np.array(applied, np.float64)[:3], float(meta.get("applied_scale") or 1.0), points,
    )  # fmt: skip


def _of_colmap(poses: ColmapModel, root: Path) -> SourceViews:
    cameras_file, images_file = model_files(poses.folder)
    cameras = colmap_cameras(cameras_file)
    views = sorted(read_images(images_file), key=lambda image: (poses.images / plain_name(image.name)).as_posix())
    names = [plain_name(image.name) for image in views]
    wanted = [poses.images / name for name in names]
    files = list_images(poses.images)
    images = PhotoFinder([poses.images], loose_folders=True).find([image.name for image in views])
    if poses.in_order and len(files) == len(names) and not any(images):
        images = list(files)
    matrices = np.zeros((len(views), 3, 4))
    for matrix, image in zip(matrices, views, strict=True):
        if image.camera not in cameras:
            raise UserError(
                f"{images_file} gives {image.name} the camera {image.camera}, which {cameras_file} lacks: export the "
                "model again."
            )
        length = np.linalg.norm(image.quaternion)
        if not (length > 0 and np.isfinite(image.translation).all()):
            raise UserError(f"{images_file} gives {image.name} a pose that is no number: export the model again.")
        world_to_camera = np.eye(4)
        world_to_camera[:3] = np.c_[rotation_of(image.quaternion / length), image.translation]
        matrix[:] = np.linalg.inv(world_to_camera)[:3] * [1.0, -1.0, -1.0, 1.0]
    matrices = _COLMAP_APPLIED[:, :3] @ matrices
    members = {
        split: _split(split, names, _listed(root / f"{split}_list.txt"), poses.folder, poses.images)
        for split in SPLITS
        if (root / f"{split}_list.txt").is_file()
    }
    return SourceViews(
        poses.folder, names, wanted, images, matrices, [cameras[image.camera] for image in views], members or None,
        applied=_COLMAP_APPLIED,
    )  # fmt: skip


def _of_table(table: PoseTable) -> SourceViews:
    lens = (0.0,) * 6
    if table.lens is not None:
        lens = tuple(read_lens(table.lens, table.sizes[0].tolist(), float(table.K[0, 0, 0])).tolist())
    cameras: list[FrameCamera | None] = [
        FrameCamera(K[0, 0], K[1, 1], K[0, 2], K[1, 2], int(width), int(height), lens, "PINHOLE")
        for K, (width, height) in zip(table.K, table.sizes, strict=True)
    ]
    names = [path.as_posix() for path in table.images]
    return SourceViews(
        table.file, names, list(table.images), list(table.images), table.camera_to_world.astype(np.float64), cameras,
        missing=table.missing,
    )  # fmt: skip


def _listed(file: Path) -> list[str]:
    """Read a list of images, a line each."""
    try:
        return [line for line in read_text(file).splitlines() if line.strip()]
    except (OSError, ValueError) as error:
        raise UserError(f"{file} cannot be read ({reason(error)}): write the name of an image on each line.") from error


def _split(split: str, names: Sequence[str], members: Sequence[str], file: Path, folder: Path) -> list[int]:
    """Return the indices of the views that a split names; raise ``UserError`` for one without a pose.

    names: of the views. members: names of the split's photos. folder: of these, for messages.
    """
    index_of = {name: index for index, name in enumerate(names)}
    of_stem = {without_suffix(name): index for name, index in index_of.items()}
    indices = set()
    for member in members:
        name = plain_name(member)
        index = index_of.get(name, of_stem.get(without_suffix(name)))
        if index is None:
            raise UserError(
                f"the split {split} names {folder / name}, of which {file} has no pose: correct the name, or delete "
                "the split."
            )
        indices.add(index)
    return sorted(indices)
