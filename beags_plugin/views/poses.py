"""Poses of all views of a scene in nerfstudio's normalised world, from the source that the layout names."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import torch
from torch import Tensor

from beags_plugin.data.dataset import Poses
from beags_plugin.data.files import photo_names
from beags_plugin.data.frame_cameras import FrameCamera
from beags_plugin.data.photo_files import missing_note, without_suffix
from beags_plugin.system.errors import UserError
from beags_plugin.views.cameras import CAMERA_TYPES, SceneCameras
from beags_plugin.views.data_options import DataOptions
from beags_plugin.views.placing import Placing, far_note, place
from beags_plugin.views.pose_sources import read_source


@dataclass
class PosedViews:
    """All views of a scene, sorted by name, before they are split.

    stems: names of each view: the stem of its file, that in the poses, and its path below the folder of all files.
    members: split name to indices of its views; None if the poses name no splits. placing: how the world of the poses'
    file was moved. points: a .ply of seed points in that world that the poses name, or None. notes: sentences for the
    user.
    """

    images: list[Path]
    stems: list[set[str]]
    cameras: SceneCameras
    members: dict[str, list[int]] | None
    placing: Placing
    points: Path | None = None
    notes: tuple[str, ...] = ()


def read_poses(poses: Poses, root: Path, options: DataOptions) -> PosedViews:
    """Read the views of a scene in ``root``; raise ``UserError`` if they cannot be read or there are too few.

    Views whose photos are missing are left out with a note; it is an error if they are more than half, or with
    ``strict``.
    """
    source = read_source(poses, root)
    file = source.file
    if not source.names:
        raise UserError(f"{file} holds no images: give poses for at least two.")
    if len(source.names) < 2 and source.members is None:
        raise UserError(f"{file} holds the pose of one image alone: give poses for at least two.")
    missing = [path for path, image in zip(source.wanted, source.images, strict=True) if image is None]
    missing += source.missing
    notes = [missing_note(missing, len(source.names) + len(source.missing), file, options.strict)]
    # Views without a photo count here too, so that a run keeps its world when a photo is removed.
    placed, placing = place(
        source.camera_to_world, options, file, source.orientation, source.applied, source.applied_scale
    )
    notes.append(far_note(placing, options.center_method == "none"))
    there = [index for index, image in enumerate(source.images) if image is not None]
    images = [image.absolute() for image in source.images if image is not None]
    cameras = _cameras(file, [camera for index in there if (camera := source.cameras[index])], placed[there], images)
    members = source.members
    if members is not None:
        place_of = {index: position for position, index in enumerate(there)}
        members = {
            split: [place_of[index] for index in indices if index in place_of] for split, indices in members.items()
        }
    named = [PurePosixPath(without_suffix(source.names[index])).name for index in there]
    stems = [{name, image.stem, whole} for name, image, whole in zip(named, images, photo_names(images), strict=True)]
    return PosedViews(
        images, stems, cameras, members, placing, source.points, tuple(note for note in notes if note is not None)
    )


def _cameras(file: Path, given: Sequence[FrameCamera], poses: Tensor, images: Sequence[Path]) -> SceneCameras:
    """Return the cameras; poses: [V, 3, 4] float32. Raises ``UserError`` for an unknown kind of camera."""
    for camera, image in zip(given, images, strict=True):
        if camera.model not in CAMERA_TYPES:
            raise UserError(
                f"the camera of {image} in {file} is of the model {camera.model!r}, which is unknown: name OPENCV or "
                "OPENCV_FISHEYE, or undistort the photos."
            )
    K = torch.tensor([[camera.fx, camera.fy, camera.cx, camera.cy] for camera in given], dtype=torch.float64).float()
    sizes = torch.tensor([[camera.width, camera.height] for camera in given])
    return SceneCameras(
        camera_to_worlds=poses,
        fx=K[:, 0:1],
        fy=K[:, 1:2],
        cx=K[:, 2:3],
        cy=K[:, 3:4],
        width=sizes[:, :1],
        height=sizes[:, 1:],
        distortion_params=torch.tensor([camera.lens for camera in given]),
        camera_type=torch.tensor([CAMERA_TYPES[camera.model] for camera in given])[:, None],
    )
