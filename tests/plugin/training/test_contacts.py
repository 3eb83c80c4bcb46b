"""The end of a refinement that closes objects where they touch: what it adds, and how a resumed run ends."""

from __future__ import annotations

import sys

import pytest
import torch

pytest.importorskip("nerfstudio")
pytest.importorskip("open3d")

from resumed_runs import (
    STEPS,
    assert_same_run,
    checkpoint_of,
    interrupted,
    kill_at,
    killed,
    resume_to_end,
    run_to_end,
    short_config,
)
from run_folders import CLASSES, write_scene
from same_bits import differences

from beags_plugin.objects.evaluate import evaluate_run
from beags_plugin.plugin.training import contacts
from beags_plugin.runs.read import read_run
from beags_plugin.surfaces.contact_faces import ContactFaces

CLOSE, OPEN = ({"pipeline.model.close_contacts": closed} for closed in (True, False))


@pytest.fixture
def data(tmp_path):
    write_scene(tmp_path / "data")
    return tmp_path / "data"


@pytest.fixture
def three_faces(monkeypatch):
    """Let contacts ask for three Gaussians, two of the last object and one of the one before; returns the calls."""
    calls = []

    def faces(surfels, members, names, views, labels, options, progress):
        calls.append((names, views, labels))
        last, before = sorted(names)[-1], sorted(names)[-2]
        return ContactFaces(surfels[:3], torch.tensor([last, before, last], dtype=torch.int32))

    monkeypatch.setattr(contacts, "contact_faces", faces)
    return calls


def test_the_last_step_adds_the_faces_and_changes_nothing_else(data, tmp_path, three_faces, capsys):
    run_to_end(short_config(data, tmp_path / "without", **OPEN))
    run_to_end(short_config(data, tmp_path / "with", **CLOSE))
    assert "closed where neighbours hide objects: 1 of " in capsys.readouterr().out
    (call,) = three_faces
    names, views, labels = call
    assert names == CLASSES and len(views.cameras) == len(labels)
    assert all(
        tuple(each.shape) == (camera.height, camera.width) for each, camera in zip(labels, views.cameras, strict=True)
    )
    without, with_ = (read_run(tmp_path / name / "config.yml") for name in ("without", "with"))
    count = len(without.members)
    assert len(with_.members) == count + 3
    assert with_.surfels()[:count].means.equal(without.surfels().means)
    assert with_.surfels()[count:].means.equal(without.surfels()[:3].means)
    assert with_.members.class_ids[:count].equal(without.members.class_ids)
    last, before = sorted(CLASSES)[-1], sorted(CLASSES)[-2]
    assert with_.members.class_ids[count:].tolist() == [last, before, last]
    assert evaluate_run(tmp_path / "with/config.yml").after.objects[last].extracted is not None


@pytest.mark.parametrize("after", [False, True])
def test_a_run_that_was_killed_in_its_last_step_ends_the_same(data, tmp_path, three_faces, monkeypatch, after):
    run_to_end(short_config(data, tmp_path / "whole", **CLOSE))

    def kill(patch):
        kill_at(patch, sum(STEPS) - 1, after)

    interrupted(data, tmp_path / "killed", monkeypatch, kill, **CLOSE)
    resume_to_end(tmp_path / "killed")
    assert_same_run(tmp_path / "whole", tmp_path / "killed")


def test_a_scene_of_noise_is_closed_or_says_that_there_is_nothing_to_close(data, tmp_path, capsys):
    run_to_end(short_config(data, tmp_path / "run", **CLOSE))
    said = capsys.readouterr().out
    assert ("no contact to close" in said) != ("closed where neighbours hide objects" in said)
    assert checkpoint_of(tmp_path / "run")


def test_a_refiner_that_trains_nothing_closes_nothing(data, tmp_path, three_faces):
    changes = {"pipeline.model.refiner": "none", "pipeline.model.refine_steps": 1}
    run_to_end(short_config(data, tmp_path / "run", **CLOSE, **changes))
    assert not three_faces


def test_a_run_that_was_killed_while_it_closed_contacts_ends_the_same(data, tmp_path, three_faces, monkeypatch):
    run_to_end(short_config(data, tmp_path / "whole", **CLOSE))
    interrupted(
        data, tmp_path / "killed", monkeypatch, lambda patch: patch.setattr(contacts, "contact_faces", killed), **CLOSE
    )
    assert checkpoint_of(tmp_path / "killed")["step"] == sum(STEPS) - 2, "all but one step is on disk"
    resume_to_end(tmp_path / "killed")
    assert_same_run(tmp_path / "whole", tmp_path / "killed")


def test_a_run_that_cannot_be_closed_is_kept_as_it_was_trained(data, tmp_path, monkeypatch, capsys):
    run_to_end(short_config(data, tmp_path / "without", **OPEN))
    monkeypatch.setitem(sys.modules, "open3d", None)  # an import of it fails
    run_to_end(short_config(data, tmp_path / "with", **CLOSE))
    said = " ".join(capsys.readouterr().out.split())
    assert "Objects stay open where others hide them, as closing them failed (import of open3d" in said
    without, with_ = (checkpoint_of(tmp_path / name)["pipeline"] for name in ("without", "with"))
    assert not differences(without, with_)
