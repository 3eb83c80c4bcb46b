"""Pictures of objects side by side: split where there are many variants, limited where there are many objects."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("nerfstudio")

from PIL import Image
from run_folders import write_scene, write_trained

from beags_benchmarks.experiments import objects_picture
from beags_benchmarks.experiments.engines.interface import Outcome
from beags_benchmarks.experiments.experiment import Variant
from beags_benchmarks.experiments.objects_picture import captioned, pages, plot_objects
from beags_benchmarks.experiments.scenes import TrialScene
from beags_benchmarks.experiments.trials import Trial, VariantTrial
from beags_plugin.pictures.cells import CAPTION, FURTHER_LINE, GAP

SIDE = objects_picture._SIDE


def flat(value: int) -> np.ndarray:
    return np.full((5, 7, 3), value, np.uint8)


@pytest.mark.parametrize(("variants", "columns"), [(1, [1]), (10, [10]), (11, [5, 6]), (29, [9, 10, 10])])
def test_many_variants_are_shared_out_to_pictures_that_all_begin_with_the_photo(variants, columns):
    found = pages([[flat(line), *(flat(100 + v) for v in range(variants))] for line in range(3)])
    assert [picture.shape for picture in found] == [(3 * (5 + GAP), (7 + GAP) * (1 + n), 3) for n in columns]
    shown = [picture[2, 3 :: 7 + GAP, 0].tolist() for picture in found]
    assert all(line[0] == 0 for line in shown) and sum((line[1:] for line in shown), []) == list(
        range(100, 100 + variants)
    )
    assert [picture[2 * (5 + GAP), 0, 0] for picture in found] == [2] * len(columns)
    assert pages([]) == []


def test_long_names_take_as_many_lines_as_the_longest_of_them():
    assert captioned(["room 100: cup", "beags"]) == ["room 100: cup", "beags"]
    found = captioned(["as long as beags-fast, neither loss", "beags"])
    assert found == ["as long as beags-fast,\nneither loss", "beags\n"]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Three variants on two scenes, the second of which fails on the first scene, and their outcomes."""
    root, runs, outcomes = tmp_path_factory.mktemp("objects"), [], {}
    data = write_scene(root / "data", truth_factor=1)
    for name in ("a", "b"):
        scene = TrialScene(name, data, 1.0, name)
        for variant in ("none", "fails", "as long as another one, neither loss"):
            trial = Trial(scene, "beags-tiny", {"variant": variant}, 42, "code")
            runs.append(VariantTrial(Variant(variant), scene, 42, (trial,)))
            failed = "no memory" if (name, variant) == ("a", "fails") else None
            folder = root / trial.folder_name
            outcomes[trial.digest] = Outcome(folder, None if failed else {}, failed)
            if not failed:
                write_trained(folder / "run", data, base=False)
    return runs, outcomes


def read(path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image)


def test_every_object_is_drawn_by_every_variant(trained, tmp_path):
    (path,) = plot_objects(tmp_path / "objects.png", *trained)
    picture, height = read(path), SIDE + CAPTION + FURTHER_LINE
    assert path.name == "objects.png" and picture.shape == (4 * (height + GAP), 4 * (SIDE + GAP), 3)
    cells = picture.reshape(4, height + GAP, 4, SIDE + GAP, 3)[:, CAPTION + FURTHER_LINE : -GAP, :, :-GAP]
    empty = (cells == 255).all(axis=(1, 3, 4))
    assert empty.tolist() == [[False, False, True, False]] * 2 + [[False] * 4] * 2
    assert (cells[:, :, 1] == cells[:, :, 3]).all(), "the same run"
    assert (cells[0, :, 1] != cells[1, :, 1]).any(), "cup and box"


def test_many_objects_and_variants_are_limited_and_split(trained, tmp_path, monkeypatch):
    whole = read(plot_objects(tmp_path / "whole.png", *trained)[0])
    monkeypatch.setattr(objects_picture, "_LINES", 2)
    monkeypatch.setattr(objects_picture, "pages", lambda lines: pages(lines, columns=2))
    paths = plot_objects(tmp_path / "objects.png", *trained)
    assert [path.name for path in paths] == ["objects.png", "objects-2.png"]
    height, width = SIDE + CAPTION + FURTHER_LINE + GAP, SIDE + GAP
    first, second = map(read, paths)
    assert (first.shape, second.shape) == ((2 * height, 2 * width, 3), (2 * height, 3 * width, 3))
    cups = np.concatenate([whole[:height], whole[2 * height : 3 * height]])  # the larger object of each scene
    assert (first == cups[:, : 2 * width]).all()
    assert (second == np.concatenate([cups[:, :width], cups[:, 2 * width :]], axis=1)).all()
