"""Which Gaussians belong to an object is decided once, and kept while a run has the same Gaussians and masks."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import torch

pytest.importorskip("nerfstudio")

from run_folders import discs, state_of, write_prepared, write_scene, write_trained

from beags_plugin.cleaning.clean import LeftOut
from beags_plugin.objects import clean
from beags_plugin.objects.clean import decide
from beags_plugin.objects.extract import extract_objects
from beags_plugin.runs.belonging import BELONGING_FILE, Belonging
from beags_plugin.runs.relocation import open_run
from beags_plugin.runs.run import Run
from beags_plugin.runs.write import write_run


@pytest.fixture
def config(tmp_path) -> Path:
    write_scene(tmp_path / "lab")
    found = write_trained(tmp_path / "run", tmp_path / "lab")
    write_prepared(found.parent)
    return found


@pytest.fixture
def asked(monkeypatch) -> list[int]:
    """The classes about which masks are asked, each of which loses its first two Gaussians."""
    classes: list[int] = []

    def first_two_go(part, class_id, views):
        classes.append(class_id)
        return torch.arange(2, len(part)), LeftOut(outside=2)

    monkeypatch.setattr(clean, "clean", first_two_go)
    return classes


def left(config: Path) -> dict[str, tuple[int, LeftOut | None]]:
    return {one.name: (one.gaussians, one.left_out) for one in extract_objects(config)}


def test_the_end_of_a_training_decides_and_later_commands_do_not_ask_again(config, asked):
    decide(config)
    assert sorted(asked) == [1, 2]
    expected = {name: (23, LeftOut(outside=2)) for name in ("cup", "box")}
    assert left(config) == expected and sorted(asked) == [1, 2]
    shutil.rmtree(open_run(config).data_path)  # The photos are not needed either.
    assert left(config) == expected


def test_an_old_run_gets_it_on_first_use_and_a_damaged_file_is_replaced(config, asked):
    left(config)
    left(config)
    assert sorted(asked) == [1, 2]
    (config.parent / BELONGING_FILE).write_bytes(b"cut off")
    left(config)
    left(config)
    assert sorted(asked) == [1, 1, 2, 2]


@pytest.mark.parametrize("what", ["Gaussians", "classes", "masks"])
def test_it_is_decided_anew_for_others(config, asked, what):
    left(config)
    surfels, ids = discs()
    if what == "masks":
        next((config.parent / "prepared/masks").glob("*.png")).unlink()
    else:
        moved, other = discs(shift=0.01)[0] if what == "Gaussians" else surfels, ids.clone()
        other[-1] = 1 if what == "classes" else other[-1]
        write_run(open_run(config), config.parent, state_of(moved, other), 199)
    run = Run(config)
    assert Belonging(run.scene, run.folder).known(1) is None


def test_a_folder_that_cannot_be_written_costs_time_alone(config, asked, monkeypatch):
    def refused(*_):
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr("beags_plugin.runs.belonging.write_whole", refused)
    assert left(config)["cup"][0] == 23 and not (config.parent / BELONGING_FILE).exists()
