"""Photos of a known scene, through ``beags process``: its poses, its files, and what it says and keeps."""

from __future__ import annotations

import json
import shutil
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

pycolmap = pytest.importorskip("pycolmap")
from photographed_corner import camera, photograph, write_photos
from PIL import Image

from beags_plugin.commands.cli import main
from beags_plugin.posing.files import MODEL
from beags_plugin.posing.process import REPORT, process
from beags_plugin.posing.video import choose_frames, take_frames
from beags_plugin.system.reading.ply import read_ply_points
from benchmarks.poses import errors


@contextmanager
def quiet(name):
    yield lambda done, total: None


def frames(folder: Path) -> dict[str, np.ndarray]:
    meta = json.loads((folder / "transforms.json").read_text())
    return {Path(frame["file_path"]).stem: np.array(frame["transform_matrix"]) for frame in meta["frames"]}


@pytest.fixture(scope="module")
def posed(tmp_path_factory):
    """Return the folder of a scene made by the command from twelve photos, and the true poses."""
    root = tmp_path_factory.mktemp("posed")
    given = write_photos(root / "photos")
    main(["process", "--data", str(root / "photos"), "--output-dir", str(root / "scene")])
    return root / "scene", given


def test_poses_are_those_of_the_cameras(posed):
    folder, given = posed
    found = frames(folder)
    assert found.keys() == given.keys()
    turned, moved = errors(found, given)
    assert np.median(turned) < 0.3 and np.median(moved) < 0.005
    meta = json.loads((folder / "transforms.json").read_text())
    assert meta["fl_x"] == pytest.approx(300, rel=0.02) and (meta["w"], meta["h"]) == (320, 240)


def test_points_lie_before_the_cameras_of_the_same_file(posed):
    folder, _ = posed
    points, colors = read_ply_points(folder / "sparse_pc.ply")
    assert len(points) > 300 and colors.std() > 10
    for pose in frames(folder).values():
        depth = -(points - pose[:3, 3]) @ pose[:3, 2]
        assert np.mean(depth > 0) > 0.95
    assert pycolmap.Reconstruction(folder / MODEL).num_points3D() == len(points)
    report = json.loads((folder / REPORT).read_text())
    assert (report["registered"], report["photos"], report["notes"]) == (12, 12, [])
    assert Image.open(folder / "poses.png").size[0] == 1200


def test_ns_train_reads_the_scene(posed):
    pytest.importorskip("nerfstudio")
    from beags_plugin.plugin.views.dataparser import BeagsDataParserConfig

    parser = BeagsDataParserConfig(data=posed[0]).setup()
    outputs = parser.get_dataparser_outputs("train")
    assert len(outputs.image_filenames) == 10  # every eighth is held out
    assert len(outputs.metadata["points3D_xyz"]) == len(read_ply_points(posed[0] / "sparse_pc.ply")[0])


def test_a_second_call_computes_nothing_and_more_photos_only_what_is_new(posed, tmp_path, monkeypatch):
    folder, given = tmp_path / "scene", posed[1]
    shutil.copytree(posed[0], folder)
    before = (folder / "transforms.json").read_bytes()
    monkeypatch.setattr("beags_plugin.posing.features._features", lambda *_: pytest.fail("computed again"))
    monkeypatch.setattr("beags_plugin.posing.process.place", lambda *_: pytest.fail("computed again"))
    process(folder / "images", folder, quiet)
    assert (folder / "transforms.json").read_bytes() == before
    monkeypatch.undo()
    Image.fromarray(photograph(camera(0.75, 2.0))).save(tmp_path / "scene/images/w.png")
    report, _ = process(folder / "images", folder, quiet)
    assert report.registered == len(given) + 1


def test_the_same_photos_give_the_same_poses(posed, tmp_path):
    process(posed[0] / "images", tmp_path / "again", quiet)
    assert (tmp_path / "again/transforms.json").read_bytes() == (posed[0] / "transforms.json").read_bytes()


def test_groups_blur_repeats_and_kinds_of_photos_get_a_sentence_each(tmp_path):
    photos = tmp_path / "photos"
    write_photos(photos, 9, "a")
    write_photos(photos, 6, "b", seed=7)
    write_photos(photos, 7, "p", turned=True)
    blurred = np.asarray(Image.open(photos / "a04.png").reduce(10).resize((320, 240)))
    Image.fromarray(blurred).save(photos / "a04x.png")
    shutil.copy(photos / "a02.png", photos / "a02x.png")
    report, _ = process(photos, tmp_path / "scene", quiet)
    said = "\n".join(report.notes)
    assert "a04x.png look blurred" in said and "a02x.png show the same" in said
    assert "portrait" in said and report.cameras == 2
    assert "groups of" in said and report.groups[1] == 6
    lenses = [frame["w"] for frame in json.loads((tmp_path / "scene/transforms.json").read_text())["frames"]]
    assert sorted(set(lenses)) == [240, 320]


def test_the_middle_of_a_lens_is_found_where_it_is_far_from_that_of_the_photo(tmp_path):
    given = write_photos(tmp_path / "photos", 14, shift=(14.0, -9.0))
    process(tmp_path / "photos", tmp_path / "scene", quiet)
    turned, _ = errors(frames(tmp_path / "scene"), given)
    assert np.median(turned) < 0.4  # 14 pixels are 2.7 degrees


def test_frames_are_the_sharpest_of_each_stretch_of_motion():
    motions = np.array([0, 0.0, 0.0, 0.02, 0.02, 0.0, 0.04, 0.04])
    sharpness = np.array([1, 5, 2, 1, 1, 9, 3, 4])
    assert choose_frames(motions, sharpness) == [1, 5, 6, 7]


def test_a_video_gives_frames_and_a_second_call_takes_them(tmp_path, monkeypatch):
    import av

    with av.open(str(tmp_path / "walk.mp4"), "w") as container:
        stream = container.add_stream("mpeg4", rate=25)
        stream.width, stream.height, stream.pix_fmt, stream.bit_rate = 320, 240, "yuv420p", 8_000_000
        for angle in np.repeat(np.linspace(0.3, 1.2, 12), 3):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(photograph(camera(float(angle))), format="rgb24")))
        container.mux(stream.encode())
    files = take_frames(tmp_path / "walk.mp4", tmp_path / "frames", quiet)
    stands = {(int(file.stem[-5:]) - 1) // 3 for file in files}
    assert len(files) == len(stands) >= 6  # of twelve; standing still gives none
    monkeypatch.setattr("beags_plugin.posing.video._frames", lambda *_: pytest.fail("decoded again"))
    assert take_frames(tmp_path / "walk.mp4", tmp_path / "frames", quiet) == files
