"""What finished runs need of nerfstudio is written again here, and gives the same bits."""

from __future__ import annotations

import struct
from types import SimpleNamespace

import numpy as np
import pytest
import torch

pytest.importorskip("nerfstudio")

from nerfstudio.cameras.camera_utils import auto_orient_and_center_poses
from nerfstudio.cameras.cameras import CAMERA_MODEL_TO_TYPE, Cameras, CameraType
from nerfstudio.data.datamanagers.full_images_datamanager import _undistort_image
from nerfstudio.data.utils import colmap_parsing_utils as colmap
from nerfstudio.process_data.colmap_utils import parse_colmap_camera_params

from beags_plugin.data.frame_cameras import LENS
from beags_plugin.plugin.views.dataparser import nerfstudio_cameras
from beags_plugin.views.cameras import CAMERA_TYPES, FISHEYE, PERSPECTIVE, SceneCameras, camera_from_nerfstudio
from beags_plugin.views.colmap_files import colmap_cameras
from beags_plugin.views.colmap_model import read_cameras, rotation_of
from beags_plugin.views.lens import straighten, undistort_image
from beags_plugin.views.orientation import oriented


def poses(seed: int, flat: bool = False) -> torch.Tensor:
    """Cameras [8, 4, 4] around a point; flat: all turned about one axis, as in front of a wall."""
    rng = np.random.default_rng(seed)
    found = np.tile(np.eye(4), (8, 1, 1))
    for pose in found:
        turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        pose[:3, :3] = np.eye(3) if flat else turn * np.sign(np.linalg.det(turn))
        pose[:3, 3] = rng.normal(size=3) * (3.0, 2.0, 1.0)
    return torch.from_numpy(found).float()


@pytest.mark.parametrize("method", ["pca", "up", "vertical", "none"])
@pytest.mark.parametrize("center", ["poses", "none"])
@pytest.mark.parametrize("flat", [False, True])
def test_poses_are_normalised_alike(method, center, flat):
    for seed in range(3):
        given = poses(seed, flat)
        for one, other in zip(
            oriented(given.clone(), method, center == "poses"),
            auto_orient_and_center_poses(given.clone(), method=method, center_method=center),
            strict=True,
        ):
            assert torch.equal(one, other)


def test_rotations_and_camera_types_are_alike():
    quaternions = np.random.default_rng(0).normal(size=(20, 4))
    for each in quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True):
        assert (rotation_of(each) == colmap.qvec2rotmat(each)).all()
    assert {name: kind.value for name, kind in CAMERA_MODEL_TO_TYPE.items()} == CAMERA_TYPES
    assert (CameraType.PERSPECTIVE.value, CameraType.FISHEYE.value) == (PERSPECTIVE, FISHEYE)


def test_colmap_cameras_are_alike(tmp_path):
    rng, file = np.random.default_rng(0), tmp_path / "cameras.bin"
    known = sorted(colmap.CAMERA_MODELS, key=lambda model: model.model_id)
    content = struct.pack("<Q", len(known))
    for model in known:
        params = rng.uniform(0.1, 900.0, model.num_params)
        content += struct.pack(f"<iiQQ{model.num_params}d", model.model_id + 1, model.model_id, 640, 480, *params)
    file.write_bytes(content)
    theirs, ours = colmap.read_cameras_binary(file), read_cameras(file)
    assert list(ours) == list(theirs)
    for index, camera in theirs.items():
        same = ours[index]
        assert (same.model, same.width, same.height) == (camera.model, 640, 480)
        assert (same.params == camera.params).all()
        text = " ".join([str(index), camera.model, "640", "480", *(repr(float(value)) for value in camera.params)])
        one = tmp_path / "cameras.txt"
        one.write_text(text)
        try:
            entries = parse_colmap_camera_params(SimpleNamespace(**camera._asdict()))
        except NotImplementedError:
            with pytest.raises(Exception, match=f"lens {camera.model}, which is not supported"):
                colmap_cameras(one)
            continue
        found = colmap_cameras(one)[index]
        assert (found.fx, found.fy, found.cx, found.cy) == tuple(entries[key] for key in ("fl_x", "fl_y", "cx", "cy"))
        assert found.lens == tuple(float(entries.get(name, 0.0)) for name in LENS)
        assert (found.model, found.width, found.height) == (entries["camera_model"], entries["w"], entries["h"])


@pytest.mark.parametrize("kind", [PERSPECTIVE, FISHEYE])
def test_photos_lose_their_lens_alike(kind):
    lens = [-0.12, 0.03, 0.004, 0.0, 0.001, -0.002] if kind == PERSPECTIVE else [0.05, -0.01, 0.002, 0.0, 0.0, 0.0]
    parts = {"fx": 71.3, "fy": 70.1, "cx": 41.7, "cy": 29.2}
    cameras = SceneCameras(
        torch.eye(4)[None, :3],
        **{name: torch.tensor([[value]]) for name, value in parts.items()},
        width=torch.tensor([[80]]), height=torch.tensor([[60]]), distortion_params=torch.tensor([lens]),
        camera_type=torch.tensor([[kind]]),
    )  # fmt: skip
    theirs: Cameras = nerfstudio_cameras(cameras)
    image = np.random.default_rng(0).integers(0, 255, (60, 80, 3), np.uint8)
    K = theirs.get_intrinsics_matrices()[0].numpy()
    assert (camera_from_nerfstudio(cameras, 0).K.numpy() == K).all()
    new_K, straight, _ = _undistort_image(theirs[0], np.array(lens, np.float32), {}, image.copy(), K)
    assert (undistort_image(image, cameras, 0) == straight).all()
    straighten(cameras)
    assert (int(cameras.width[0]), int(cameras.height[0])) == straight.shape[1::-1]
    assert (camera_from_nerfstudio(cameras, 0).K.numpy() == np.float32(new_K)).all()
