"""``beags bench scaling``: the synthetic scene, the figures and the files."""

from __future__ import annotations

import csv
import json

import pytest
import torch

from beags_plugin.bench import scaling
from beags_plugin.bench.memory import peak_of
from beags_plugin.bench.scaling import Options, Row, run_scaling, slopes
from beags_plugin.bench.scaling_scene import Sizes, make_scene
from beags_plugin.bench.scaling_stages import CHANNELS, STAGES, STEP, VOXEL, stages
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.system.errors import UserError

SMALL = Sizes(classes=5, views=3, gaussians=800, pixels=1728)


def test_the_scene_has_the_sizes_that_were_asked_for():
    scene = make_scene(SMALL, make_rasterizer())
    assert len(scene.surfels) == len(scene.class_ids) == 800
    assert len(scene.cameras) == len(scene.images) == len(scene.labels) == 3
    for camera, image, mask in zip(scene.cameras, scene.images, scene.labels, strict=True):
        assert (camera.width, camera.height) == (48, 36)
        assert image.shape == (36, 48, 3) and mask.shape == (36, 48) and mask.dtype == torch.int32
        assert 0.2 < (mask > 0).double().mean() < 0.7  # the ball is before the backdrop
        assert torch.allclose(camera.rotation @ camera.rotation.T, torch.eye(3), atol=1e-5)
        assert (camera.rotation @ camera.center).norm() == pytest.approx(3.2, rel=1e-4)
    assert torch.cat([mask.view(-1) for mask in scene.labels]).unique().tolist() == list(range(6))


def test_classes_change_neither_shapes_nor_pictures():
    few, many = (make_scene(Sizes(n, 2, 800, 768), make_rasterizer()) for n in (1, 40))
    assert torch.equal(few.surfels.means, many.surfels.means) and torch.equal(few.surfels.quats, many.surfels.quats)
    assert all(torch.equal(a, b) for a, b in zip(few.images, many.images, strict=True))
    assert few.class_ids.unique().tolist() == [0, 1] and many.class_ids.unique().tolist() == list(range(41))


def test_discs_lie_on_their_spheres():
    scene = make_scene(SMALL, make_rasterizer())
    w, x, y, z = torch.nn.functional.normalize(scene.surfels.quats, dim=1).unbind(1)
    normals = torch.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], dim=1)
    outward = torch.nn.functional.normalize(scene.surfels.means, dim=1)
    assert torch.allclose(normals, outward, atol=1e-3)


def test_every_stage_runs_and_training_sees_the_same_scene_each_time():
    scene = make_scene(Sizes(4, 2, 500, 768), make_rasterizer())
    calls = stages(scene, make_rasterizer(), channels=True)
    assert list(calls) == list(STAGES)
    assert list(stages(scene, make_rasterizer(), channels=False)) == [name for name in STAGES if name != CHANNELS]
    for name in (STEP, CHANNELS):
        first = [calls[name]() for _ in range(2)]  # two views
        again = [calls[name]() for _ in range(2)]
        assert first[0] > 0 and first[0] != first[1]
        # the occupancy loss draws new samples in each step
        assert again == pytest.approx(first, rel=0.05 if name == STEP else 1e-4)
    labels = [mask.labels for mask in calls[VOXEL]()]
    assert min(float((a == b).double().mean()) for a, b in zip(labels, scene.labels, strict=True)) > 0.9
    of_ball = scene.class_ids > 0
    assigned = calls["assignment"]()
    seen = of_ball & ~assigned.never_seen
    assert float((assigned.class_ids == scene.class_ids)[seen].double().mean()) > 0.8  # discs at the rim show little


def test_slopes_are_those_of_power_laws():
    rows = [Row("views", v, STEP, 0.5 * v**2.0, None if v == 8 else 3.0 * v) for v in (2, 4, 8)]
    slope = next(s for s in slopes(rows) if s.stage == STEP)
    assert slope.time == pytest.approx(2.0) and slope.memory == pytest.approx(1.0)
    assert next(s for s in slopes(rows) if s.stage == VOXEL).time is None


def test_peak_memory_is_that_of_the_call():
    peak = peak_of(lambda: torch.ones(10_000_000).sum())
    if peak is None:
        pytest.skip("this system does not tell the peak memory of a process")
    assert 39 < peak < 60


def test_files_and_tables(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(scaling.CONSOLE, "_width", 120)
    rows = run_scaling(Options(quick=True, output=tmp_path, json=tmp_path / "deep" / "s.json"))
    report = json.loads((tmp_path / "deep" / "s.json").read_text())
    assert report["rows"] == [vars(row) for row in rows] and report["commit"] and report["machine"]
    assert {(row.axis, row.size) for row in rows} == {
        ("classes", 1), ("classes", 4), ("views", 2), ("views", 4),
        ("gaussians", 300), ("gaussians", 600), ("pixels", 768), ("pixels", 1728),
    }  # fmt: skip
    assert all(row.seconds > 0 for row in rows)
    assert {slope["stage"] for slope in report["slopes"]} == set(STAGES)
    with open(tmp_path / "scaling.csv", newline="") as file:
        assert len(list(csv.DictReader(file))) == len(rows)
    assert (tmp_path / "scaling.png").stat().st_size > 10_000
    printed = capsys.readouterr().out
    assert "Slope of time" in printed and "Milliseconds at so many classes" in printed


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"classes": (4,)}, "--classes needs two"),
        ({"views": (0, 4)}, "--views needs"),
        ({"classes": (1, 70_000)}, "65534"),
        ({"gaussians": (2, 4)}, "nothing to see"),
        ({"calls": 0}, "--calls"),
    ],
)
def test_sizes_that_cannot_be_measured_are_refused(change, words):
    with pytest.raises(UserError, match=words):
        run_scaling(Options(**change))
