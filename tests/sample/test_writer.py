"""The sample's folder: its files, their repeatability, and the folders that it may replace."""

from __future__ import annotations

import dataclasses
import json
import shutil

import numpy as np
import pytest
from PIL import Image
from sample_checks import TINY, grey, points_of, splits
from scene_distances import distance, from_background

from beags_plugin.sample import FAMILIES, writer
from beags_plugin.sample.writer import SampleConfig, is_sample, write_sample
from beags_plugin.system.errors import UserError

SMALL = {"width": 16, "height": 16, "num_train": 1, "num_test": 1, "num_points": 5, "antialias": 1}
CLASSES = {"tabletop": 8, "desk": 7}  # number of classes, with the background


@pytest.fixture(scope="module", params=CLASSES)
def config(request):
    return dataclasses.replace(TINY, family=request.param)


@pytest.fixture(scope="module")
def folder(config, tmp_path_factory):
    return write_sample(tmp_path_factory.mktemp("sample") / "tiny", config)


def test_folder_layout(folder, config):
    meta = json.loads((folder / "transforms.json").read_text())
    frames = [f["file_path"] for f in meta["frames"]]
    assert frames == sorted(frames) and len(frames) == 7
    assert sorted(meta["train_filenames"] + meta["test_filenames"]) == frames
    assert len(meta["train_filenames"]) == 5 and meta["val_filenames"] == meta["test_filenames"]
    assert (meta["w"], meta["h"]) == (24, 16) and meta["fl_x"] == meta["fl_y"] > 0
    assert all(np.array(f["transform_matrix"]).shape == (4, 4) for f in meta["frames"])
    classes = json.loads((folder / "classes.json").read_text())
    assert classes["0"] == "background" and len(classes) == CLASSES[config.family]
    for path in frames:
        stem = path.split("/")[1][:-4]
        truth = grey(folder / "ground_truth/masks" / f"{stem}.png")
        assert Image.open(folder / path).size == (24, 16) and Image.open(folder / path).mode == "RGB"
        assert truth.shape == (16, 24) and truth.max() < len(classes)
        depth = np.load(folder / "ground_truth/depth" / f"{stem}.npy")
        assert depth.dtype == np.float32 and depth.shape == (16, 24)
        for class_id, name in classes.items():
            if class_id != "0":
                silhouette = grey(folder / "ground_truth/silhouettes" / name / f"{stem}.png")
                assert set(np.unique(silhouette)) <= {0, 255}
                assert (silhouette[truth == int(class_id)] == 255).all()
        if path in meta["test_filenames"]:
            assert np.array_equal(grey(folder / "masks" / f"{stem}.png"), truth)
    assert len(list((folder / "masks").iterdir())) == 6  # a fifth of five views is dropped


def test_class_maps_are_readable_by_the_mask_module(folder, config):
    classes = pytest.importorskip("beags_plugin.labels.classes")
    for path in (folder / "masks").iterdir():
        assert np.array_equal(classes.read_id_mask(path), grey(path))
    assert len(classes.read_classes(folder / "classes.json")) == CLASSES[config.family]


def test_seed_points_lie_on_surfaces(folder, config):
    raw = (folder / "seed_points.ply").read_bytes()
    header, _, body = raw.partition(b"end_header\n")
    assert b"element vertex 101\n" in header
    records = np.frombuffer(body, dtype=[("p", "<f4", 3), ("c", "u1", 3)])
    assert len(records) == 101
    still = FAMILIES.get(config.family).scene(TINY.seed)
    points = records["p"].astype(float)
    near = [from_background(still, points)]
    near += [np.abs(distance(thing, points)) for thing in still.things]
    assert np.min(near, axis=0).max() < 6 * writer.POINT_NOISE
    assert 0.3 < np.mean(np.min(near[1:], axis=0) < 6 * writer.POINT_NOISE) <= 1.0
    assert records["c"].std() > 5


def test_written_tracks_belong_to_the_points(folder):
    tracks = json.loads((folder / "seed_tracks.json").read_text())
    assert tracks["photos"] == list(next(splits(folder)))
    assert len(tracks["points"]) == len(points_of(folder)) == TINY.num_points
    ends = [TINY.num_points * i // 5 for i in range(6)]
    for photo in range(5):
        for shown in tracks["points"][ends[photo] : ends[photo + 1]]:
            assert photo in shown and shown == sorted(set(shown)) and set(shown) <= set(range(5))


def test_nerfstudio_reads_it(folder):
    pytest.importorskip("nerfstudio")
    from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig

    parser = NerfstudioDataParserConfig(data=folder, load_3D_points=False).setup()
    assert len(parser.get_dataparser_outputs("train").image_filenames) == 5
    assert len(parser.get_dataparser_outputs("val").image_filenames) == 2
    assert len(parser.get_dataparser_outputs("test").cameras) == 2


def test_same_config_gives_the_same_bytes_and_is_not_rebuilt(folder, config, tmp_path, monkeypatch):
    calls = []
    other = write_sample(tmp_path / "again", config, progress=lambda done, total: calls.append((done, total)))
    assert calls == [(i, 7) for i in range(1, 8)]
    files = sorted(p.relative_to(folder) for p in folder.rglob("*") if p.is_file())
    assert files == sorted(p.relative_to(other) for p in other.rglob("*") if p.is_file())
    assert all((folder / f).read_bytes() == (other / f).read_bytes() for f in files)
    monkeypatch.setattr(writer, "_build", lambda *_: pytest.fail("rebuilt"))
    assert write_sample(other, config) == other


def test_another_config_replaces_a_sample(tmp_path):
    first, second = SampleConfig(seed=0, **SMALL), SampleConfig(seed=1, **SMALL)
    write_sample(tmp_path / "s", first)
    write_sample(tmp_path / "s", second)
    assert is_sample(tmp_path / "s", second) and not is_sample(tmp_path / "s", first)
    assert [p.name for p in tmp_path.iterdir()] == ["s"]


@pytest.mark.parametrize("former", [False, True])
def test_the_same_sample_by_another_program_meanwhile_is_kept(tmp_path, former):
    target, small = tmp_path / "s", SampleConfig(**SMALL)
    if former:  # another sample is there, which both are to replace
        target.mkdir()
        (target / writer.SAMPLE_FILE).write_text("{}")

    def other(done, total):
        if done == total:
            shutil.rmtree(target, ignore_errors=True)
            write_sample(target, small)
            (target / "theirs").touch()

    assert write_sample(target, small, progress=other) == target
    assert (target / "theirs").exists() and is_sample(target, small)
    assert list(tmp_path.iterdir()) == [target]


def test_what_a_user_puts_there_meanwhile_is_kept(tmp_path):
    target = tmp_path / "s"

    def user(done, total):
        target.mkdir(exist_ok=True)
        (target / "thesis.txt").write_text("mine")

    with pytest.raises(UserError, match="cannot be written"):
        write_sample(target, SampleConfig(**SMALL), progress=user)
    assert (target / "thesis.txt").read_text() == "mine" and list(tmp_path.iterdir()) == [target]


def test_an_interrupted_run_leaves_nothing_that_looks_complete(tmp_path):
    def stop(done, total):
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_sample(tmp_path / "s", TINY, progress=stop)
    assert list(tmp_path.iterdir()) == []


def test_a_foreign_folder_is_left_alone(tmp_path):
    (tmp_path / "thesis.txt").write_text("mine")
    with pytest.raises(UserError, match="no sample scene"):
        write_sample(tmp_path, TINY)
    assert (tmp_path / "thesis.txt").read_text() == "mine"


def test_a_family_of_benchmarks_says_how_to_install_it(tmp_path, monkeypatch):
    monkeypatch.setattr(FAMILIES, "names", lambda: ["desk", "tabletop"])
    with pytest.raises(UserError, match=r"'room': choose one of desk, tabletop; .* \(pip install ./benchmarks in "):
        write_sample(tmp_path / "s", SampleConfig(family="room"))
    assert list(tmp_path.iterdir()) == []
