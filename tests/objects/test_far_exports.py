"""Exports of a run whose world lies far from 0, as map coordinates do: they go back in double precision."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from random_surfels import a_rotation
from run_folders import write_scene, write_trained

pytest.importorskip("nerfstudio")

from beags_plugin.commands.cli import main
from beags_plugin.objects.export import export_run
from beags_plugin.objects.extract import extract_objects
from beags_plugin.splat_io.far_worlds import double_means, local_origin, origin_of
from beags_plugin.splat_io.frames import from_input_frame
from beags_plugin.system.reading.ply import read_vertices

MAP = torch.tensor([453_211.37, 5_411_873.94, 512.25], dtype=torch.float64)
SCALE = 0.5


@pytest.fixture(scope="module")
def far(tmp_path_factory):
    """Return config.yml of a run in map coordinates, and where its Gaussians lie there, [N, 3] float64."""
    root = tmp_path_factory.mktemp("far")
    config = write_trained(root / "run", write_scene(root / "scene"))
    rotation = a_rotation(3)
    transform = torch.cat([rotation, -(rotation @ MAP)[:, None]], dim=1)
    saved = {"transform": transform.tolist(), "scale": SCALE}
    (root / "run/dataparser_transforms.json").write_text(json.dumps(saved))
    return config


def in_map(config) -> np.ndarray:
    content = json.loads((config.parent / "dataparser_transforms.json").read_text())
    matrix = torch.tensor(content["transform"], dtype=torch.float64)
    from beags_plugin.runs.read import read_run

    means = read_run(config).surfels().means.detach().double()
    return ((means / SCALE - matrix[:, 3]) @ matrix[:, :3]).numpy()


def test_whole_splats_are_in_map_coordinates_in_double(far, tmp_path):
    said = []
    export_run(far, whole=True, formats=("ply", "ply-2dgs"), output=tmp_path, say=said.append)
    for name in ("whole_scene.ply", "whole_scene.2dgs.ply"):
        table = read_vertices(tmp_path / name)
        assert table.dtype["x"] == np.float64 and table.dtype["opacity"] == np.float32
        found = np.stack([table[axis] for axis in "xyz"], axis=1)
        np.testing.assert_allclose(found, in_map(far), atol=1e-5, rtol=0)
    assert b"SplatRenderMode: 2dgs" in (tmp_path / "whole_scene.2dgs.ply").read_bytes()[:1000]
    assert len(said) == 1 and "double precision" in said[0] and "--frame object" in said[0]
    assert not (tmp_path / "origin.json").exists()


def test_formats_of_single_precision_say_where_their_origin_lies(far, tmp_path):
    said = []
    export_run(far, ("cup",), formats=("ply", "spz"), output=tmp_path, say=said.append, keep_all=True)
    content = json.loads((tmp_path / "origin.json").read_text())
    assert content["files"] == ["cup.spz"]
    origin = np.array(content["origin"])
    assert np.abs(origin - MAP.numpy()).max() < 3.0 and (origin == np.round(origin)).all()
    assert "the other files are relative to 453211" in said[0] and "origin.json" in said[0]
    assert torch.equal(origin_of(tmp_path / "cup.spz"), torch.from_numpy(origin))
    assert origin_of(tmp_path / "cup.ply") is None
    exact = double_means(tmp_path / "cup.ply", len(read_vertices(tmp_path / "cup.ply")))
    assert exact is not None
    assert np.abs(exact.numpy() - origin).max() < 10


def test_a_file_that_is_written_anew_about_itself_has_no_origin_any_more(far, tmp_path):
    for frame in ("world", "object"):
        export_run(far, ("cup",), formats=("spz", "ply"), output=tmp_path, placement=frame, keep_all=True)
        assert (origin_of(tmp_path / "cup.spz") is None) == (frame == "object")
    assert not (tmp_path / "origin.json").exists()


def test_the_manifest_names_the_origin(far, tmp_path):
    export_run(far, everything=True, formats=("ply", "spz"), output=tmp_path, keep_all=True)
    content = json.loads((tmp_path / "manifest.json").read_text())
    for one in content["objects"]:
        by_format = {file["format"]: file for file in one["files"]}
        assert by_format["ply"]["coordinates"] == "world"
        np.testing.assert_allclose(one["center"], by_format["spz"]["origin"], atol=1e-6)
        assert np.abs(one["box"]["low"]).max() < 10  # about that origin
        to_run = np.array(one["to_run"])
        table = read_vertices(tmp_path / by_format["ply"]["path"])
        place = np.array([float(table[axis][0]) for axis in "xyz"]) - one["center"]
        assert np.abs(to_run[:3, :3] @ place + to_run[:3, 3]).max() < 2


def test_objects_about_themselves_are_small_numbers_in_single_precision(far, tmp_path):
    export_run(far, ("cup",), placement="object", output=tmp_path, keep_all=True)
    table = read_vertices(tmp_path / "cup.ply")
    assert table.dtype["x"] == np.float32
    shape = np.stack([table[axis] for axis in "xyz"], axis=1)
    exact = in_map(far)[:25] if len(shape) == 25 else None
    assert np.abs(shape).max() < 5
    if exact is not None:
        np.testing.assert_allclose(shape - shape.mean(0), exact - exact.mean(0), atol=1e-4)


def test_files_in_metres_say_their_origin(far, tmp_path):
    from beags_plugin.export.pose_options import PoseOptions

    east, north, up = (round(value) for value in MAP.tolist())
    said, pose = [], PoseOptions(scale_by=f"{east},{north},{up} {east},{north},{up + 1} 2 m")
    export_run(far, ("cup",), output=tmp_path, keep_all=True, pose=pose, say=said.append)
    table = read_vertices(tmp_path / "cup.ply")
    assert table.dtype["x"] == np.float32 and max(np.abs(table[axis]).max() for axis in "xyz") < 20
    assert "the files' origin is its point 453211" in said[0]


def test_extracted_objects_are_in_map_coordinates(far, tmp_path):
    said = []
    (one,) = extract_objects(far, ("cup",), output=tmp_path, keep_all=True, say=said.append)
    table = read_vertices(one.ply)
    assert table.dtype["x"] == np.float64 and abs(float(table["y"].mean()) - float(MAP[1])) < 10
    assert any("double precision" in sentence for sentence in said)


def test_a_run_near_0_writes_as_before(tmp_path):
    config = write_trained(tmp_path / "run", write_scene(tmp_path / "scene"))
    transform = torch.cat([a_rotation(3), torch.tensor([[0.4], [-0.2], [0.1]], dtype=torch.float64)], dim=1)
    assert local_origin(transform, 0.5) is None
    saved = {"transform": transform.tolist(), "scale": 0.5}
    (tmp_path / "run/dataparser_transforms.json").write_text(json.dumps(saved))
    said = []
    export_run(config, whole=True, output=tmp_path / "out", say=said.append)
    assert read_vertices(tmp_path / "out/whole_scene.ply").dtype["x"] == np.float32 and not said


FORMATS = {
    "ply": 1e-5,
    "ply-2dgs": 1e-5,
    "spz": 1e-5,
    "splat": 1e-5,
    "sog": 1e-3,
    "compressed-ply": 5e-3,
    "gltf-splats": 1e-5,
    "usdz-splats": 1e-5,
    "usda-splats": 1e-5,
}


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("kind", FORMATS)
def test_a_start_from_exports_is_exact(far, tmp_path, kind, turned):
    """The positions that a run starts from are those of the run that was exported, also after a turn of the axes."""
    from beags_plugin.core.flattening import flatten
    from beags_plugin.importers.base import read_scene
    from beags_plugin.plugin.training.warm_start import _moved, _placed, turned_to_fit
    from beags_plugin.runs.read import read_run

    if kind.startswith("usd"):
        pytest.importorskip("pxr.UsdVol", reason="usd-core is not installed (pip install beags[usd])")
    export_run(far, whole=True, formats=(kind,), output=tmp_path)
    (path,) = tmp_path.glob("whole_scene.*")
    assert (origin_of(path) is None) == (kind in ("ply", "ply-2dgs") or "splats" in kind)
    scene = read_scene(path)
    surfels, shift = _placed(path, scene, scene.gaussians.usable(), flatten(scene.gaussians)[0])
    content = json.loads((far.parent / "dataparser_transforms.json").read_text())
    ours = torch.tensor(content["transform"], dtype=torch.float64), content["scale"]
    expected = read_run(far).surfels().means.detach().double()

    def apart(moved) -> float:
        found = torch.cdist(moved.means.double(), expected)
        return float(torch.maximum(found.amin(dim=0).max(), found.amin(dim=1).max()))

    if turned:  # A program that takes other axes would have written it so.
        if not scene.doubtful_axes:
            return
        quarter = torch.tensor([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, 0.0]], dtype=torch.float64)
        surfels = from_input_frame(surfels, quarter, 1.0)
        assert apart(_moved(surfels, scene, "auto", ours, shift)) > 0.1
        words, moved, _ = turned_to_fit(
            surfels, lambda each: _moved(each, scene, "auto", ours, shift), lambda each: -apart(each)
        )
        assert words
    else:
        moved = _moved(surfels, scene, "auto", ours, shift)
    assert moved.means.dtype == torch.float32 and len(moved) == len(expected)
    assert apart(moved) < FORMATS[kind] * SCALE * 4


def test_the_command_says_it(far, tmp_path, capsys):
    main(["export", "--load-config", str(far), "--whole", "--output", str(tmp_path)])
    assert "single precision is too coarse" in " ".join(capsys.readouterr().out.split())
