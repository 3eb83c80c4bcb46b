"""What shortens a base, and what keeps the space before its cameras empty."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch

pytest.importorskip("nerfstudio")

from resumed_runs import Killed, assert_same_run, interrupted, kill_at, resume_to_end, run_to_end
from resumed_runs import short_config as usual_config
from run_folders import write_scene

from beags_plugin.plugin.training import densifier
from beags_plugin.system.reading.ply import write_vertices

SHORT = {
    "pipeline.model.base_lr_factor": 3.0,
    "pipeline.model.densify.free_share": 0.7,
}


@pytest.fixture
def data(short_run):
    return short_run / "data"


def test_a_base_of_all_means_is_resumed_bit_for_bit(data, tmp_path, monkeypatch):
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    run_to_end(usual_config(data, whole, **SHORT))
    interrupted(data, killed, monkeypatch, lambda patch: kill_at(patch, 17), **SHORT)
    for step in (33, 44):
        with monkeypatch.context() as patch:
            kill_at(patch, step)
            with pytest.raises(Killed):
                resume_to_end(killed)
    resume_to_end(killed)
    assert_same_run(killed, whole)


def with_seed_points(data):
    """Put 200 seed points into a scene of transforms.json, which it returns."""
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (200, 3)).astype("<f4")
    with open(data / "points.ply", "wb") as file:
        write_vertices(file, points.view([(name, "<f4") for name in "xyz"])[:, 0])
    content = json.loads((data / "transforms.json").read_text())
    (data / "transforms.json").write_text(json.dumps(content | {"ply_file_path": "points.ply"}))
    return data


@pytest.mark.parametrize("stop", [31, 11])  # the scene still grows then, or no more
def test_what_stands_before_a_camera_goes_while_the_base_trains(tmp_path, monkeypatch, stop):
    """Before each round some Gaussians are moved into the space that seed points leave empty; none of them is left."""
    data = with_seed_points(write_scene(tmp_path / "data"))
    counts, free = [], densifier.Densifier._free_cameras

    def moved(own):
        cameras, depths = own.free
        means = own.model.gauss_params["means"].data
        camera, depth = cameras[3], float(depths[3])
        assert depth > 0
        means[::4] = camera.center + 0.9 * depth * camera.rotation[2]
        before = len(means)
        free(own)
        counts.append((before, len(own.model.gauss_params["means"])))

    monkeypatch.setattr(densifier.Densifier, "_free_cameras", moved)
    monkeypatch.setattr(densifier, "MOST_FREED", 1.0)
    options = {"pipeline.model.densify.free_share": 0.7, "pipeline.model.densify.every": 15,
               "pipeline.model.densify.stop": stop, "pipeline.model.densify.start": 10,
               "pipeline.model.refine_steps": 0}  # fmt: skip
    run_to_end(usual_config(data, tmp_path / "run", **options))
    assert counts and all(after <= before - len(range(0, before, 4)) for before, after in counts)


def test_many_gaussians_before_cameras_are_a_scene_whose_seed_points_lack_what_is_near(tmp_path, monkeypatch, capsys):
    data = with_seed_points(write_scene(tmp_path / "data"))
    asked = []

    def many(surfels, cameras, depths):
        asked.append(len(surfels))
        return torch.arange(len(surfels)) % (4 if len(asked) == 1 else 10) == 0  # Later they would be few enough.

    monkeypatch.setattr(densifier, "reaches_before_camera", many)
    options = {"pipeline.model.densify.every": 15, "pipeline.model.densify.start": 10,
               "pipeline.model.densify.stop": 11}  # fmt: skip
    capsys.readouterr()
    run_to_end(usual_config(data, tmp_path / "kept", **options, **{"pipeline.model.densify.free_share": 0.7}))
    assert "25% of the Gaussians stand nearer to a camera than the seed points it shows" in capsys.readouterr().out
    run_to_end(usual_config(data, tmp_path / "never", **options, **{"pipeline.model.densify.free_share": 0.0}))
    assert len(asked) == 1
    assert_same_run(tmp_path / "kept", tmp_path / "never")
    asked.clear()
    options["pipeline.model.densify.free_share"] = 0.7
    interrupted(data, tmp_path / "killed", monkeypatch, lambda patch: kill_at(patch, 20), **options)
    resume_to_end(tmp_path / "killed")
    assert len(asked) == 1, "a run that is resumed knows that it frees nothing"
    assert_same_run(tmp_path / "killed", tmp_path / "kept")


def test_nothing_is_known_of_the_space_before_cameras_where_seed_points_were_generated(data, tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(densifier, "reaches_before_camera", lambda *of: asked.append(of))
    options = {"pipeline.model.densify.free_share": 0.7, "pipeline.model.refine_steps": 0}
    run_to_end(usual_config(data, tmp_path / "run", **options))
    assert not asked
