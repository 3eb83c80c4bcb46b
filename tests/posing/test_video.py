"""Frames of videos: which are taken, how they are turned, and the poses of the camera."""

from __future__ import annotations

import struct

import numpy as np
import pytest

pytest.importorskip("av")
pytest.importorskip("pycolmap")
from photographed_corner import camera, errors, film, frames, look_alike, photograph, quiet
from PIL import Image

from beags_plugin.posing.process import process
from beags_plugin.posing.video import choose_frames, find_frames, write_frames

ANGLES = np.linspace(0.3, 1.2, 14)
EACH = 2  # frames from one place


def test_frames_are_the_sharpest_of_each_stretch_of_motion():
    motions = np.array([0, 0.0, 0.0, 0.02, 0.02, 0.0, 0.04, 0.04])
    sharpness = np.array([1, 5, 2, 1, 1, 9, 3, 4])
    assert choose_frames(motions, sharpness) == [1, 5, 6, 7]


def test_a_video_gives_the_poses_of_its_camera_and_is_decoded_once(tmp_path, monkeypatch):
    poses = [camera(float(angle), 1.2 + 0.4 * (index % 2)) for index, angle in enumerate(ANGLES)]
    video = film(tmp_path / "walk.mp4", [photograph(pose) for pose in poses for _ in range(EACH)])
    report, _ = process(video, tmp_path / "scene", quiet)
    found = {(int(name[-5:]) - 1) // EACH: pose for name, pose in frames(tmp_path / "scene").items()}
    assert report.registered == report.photos == len(found) >= 8  # one frame from each place
    turned, moved = errors({str(k): pose for k, pose in found.items()}, {str(k): pose for k, pose in enumerate(poses)})
    assert np.median(turned) < 0.3 and np.median(moved) < 0.01
    monkeypatch.setattr("beags_plugin.posing.video._frames", lambda *_: pytest.fail("decoded again"))
    process(video, tmp_path / "scene", quiet)


@pytest.mark.parametrize(("matrix", "turns"), [((0, 1, -1, 0), 1), ((-1, 0, 0, -1), 2), ((0, -1, 1, 0), 3)])
def test_the_frames_of_a_turned_phone_are_upright(tmp_path, matrix, turns):
    """Phones store the frames of the sensor and how to turn them."""
    shown = [photograph(camera(float(angle)), turned=turns != 2) for angle in ANGLES[::3]]
    video = film(tmp_path / "phone.mp4", [np.rot90(each, turns) for each in shown])
    content = bytearray(video.read_bytes())
    a, b, c, d = (each << 16 for each in matrix)
    struct.pack_into(">9i", content, content.index(b"tkhd") + 44, a, b, 0, c, d, 0, 0, 0, 1 << 30)
    video.write_bytes(content)
    files = find_frames(video, tmp_path / "frames", quiet)
    write_frames(video, files, quiet)
    for file in files:
        assert look_alike(np.asarray(Image.open(file)), shown[int(file.stem[-5:]) - 1])
