"""Scenes of an experiment, damage done to their masks, and the options of the command."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("nerfstudio")

from experiment_files import GOOD, masks_of, scene, written

from beags_benchmarks.experiments.experiment import load_experiment
from beags_benchmarks.experiments.options import ExperimentOptions
from beags_benchmarks.experiments.per_object import object_names
from beags_benchmarks.experiments.run import adapted, scenes_of
from beags_benchmarks.experiments.scenes import (
    TrialScene,
    class_masks,
    damaged_masks,
    given_scenes,
    sample_scene,
    scene_size,
)
from beags_benchmarks.experiments.trials import MODEL, plan, steps_of
from beags_benchmarks.experiments.worker import trial_config
from beags_plugin.labels.classes import read_id_mask
from beags_plugin.sample.writer import SampleConfig, write_sample
from beags_plugin.system.errors import UserError


@pytest.fixture
def experiment(tmp_path):
    return load_experiment(written(tmp_path, GOOD))


SMALL = {"width": 48, "height": 36, "num_train": 8, "num_test": 2, "num_points": 300, "antialias": 1}


@pytest.fixture(scope="module")
def sample(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene") / "sample"
    return TrialScene("tabletop 5", write_sample(folder, SampleConfig(seed=5, **SMALL)), 1.0, "digest", seed=5)


@pytest.mark.parametrize("family", ["tabletop", "room"])
def test_a_plan_knows_of_an_unwritten_sample_what_is_read_of_a_written_one(family, tmp_path):
    planned, written = (sample_scene(tmp_path, family, 5, SMALL, write=write) for write in (False, True))
    assert planned == written and planned.data.is_dir() and planned.unwritten is None
    masks = tmp_path / "masks"
    named = [damaged_masks(planned, 1.0, masks, write=False), class_masks(planned, 3, masks, write=False)]
    elsewhere = sample_scene(tmp_path / "absent", family, 5, SMALL, write=False)
    assert elsewhere.unwritten is not None and not (tmp_path / "absent").exists() and not masks.exists()
    assert (scene_size(elsewhere), object_names(elsewhere)) == (scene_size(written), object_names(written))
    assert named == [damaged_masks(written, 1.0, masks), class_masks(written, 3, masks)]


def read_all(folder: Path) -> dict[str, np.ndarray]:
    return {path.stem: read_id_mask(path) for path in sorted(folder.glob("*.png"))}


def same(first: dict[str, np.ndarray], second: dict[str, np.ndarray]) -> bool:
    return first.keys() == second.keys() and all((first[name] == second[name]).all() for name in first)


def test_mild_damage_is_what_the_sample_has_and_none_is_the_truth(sample, tmp_path):
    mild = damaged_masks(sample, 1.0, tmp_path)
    assert same(read_all(mild), read_all(sample.data / "masks"))
    assert same(read_all(damaged_masks(sample, 0.0, tmp_path)), read_all(sample.data / "ground_truth/masks"))
    stamp = (mild / "complete").stat().st_mtime_ns
    assert damaged_masks(sample, 1.0, tmp_path) == mild and (mild / "complete").stat().st_mtime_ns == stamp


@pytest.mark.parametrize("family", ["tabletop", "room"])
def test_masks_of_a_degree_keep_the_damage_that_views_share(family, tmp_path):
    small = {**SMALL, "shared_damage": 0.75}
    shared = sample_scene(tmp_path, family, 5, small)
    assert same(read_all(damaged_masks(shared, 1.0, tmp_path)), read_all(shared.data / "masks"))
    alone = read_all(damaged_masks(shared, 0.0, tmp_path))
    truth = read_all(shared.data / "ground_truth/masks")
    wrong = {name for name in truth if (alone[name] != truth[name]).any()}
    train = json.loads((shared.data / "transforms.json").read_text())["train_filenames"]
    assert len(wrong) > 4 and wrong <= {Path(file).stem for file in train}


def test_masks_of_any_number_of_classes_cover_the_training_views(sample, tmp_path):
    found = read_all(class_masks(sample, 5, tmp_path))
    assert len(found) == SMALL["num_train"]
    made = class_masks(sample, 5, tmp_path)
    request = {"preset": "beags-tiny", "overrides": {}, "seed": 0, "data": sample.data, "downscale": 1.0, "base": None}
    config = trial_config({**request, "masks": str(made)}, tmp_path / "run")
    outputs = config.data_config.dataparser.setup().get_dataparser_outputs("test")
    assert len(outputs.metadata["classes"]) == 6 and not outputs.metadata["ground_truth"]
    assert set(np.unique(np.concatenate([mask.ravel() for mask in found.values()]))) == {1, 2, 3, 4, 5}
    assert all(len(np.unique(mask)) >= 2 for mask in found.values())


def test_more_damage_is_more_wrong_and_spares_held_out_views(sample, tmp_path):
    truth = read_all(sample.data / "ground_truth/masks")
    held_out = [Path(file).stem for file in json.loads((sample.data / "transforms.json").read_text())["test_filenames"]]
    wrong = []
    for degree in (0.5, 1.0, 2.0, 3.0):
        found = read_all(damaged_masks(sample, degree, tmp_path))
        assert all((found[name] == truth[name]).all() for name in held_out)
        wrong.append(sum(int((found.get(name, np.full_like(mask, 9)) != mask).sum()) for name, mask in truth.items()))
    assert wrong == sorted(wrong) and wrong[0] < wrong[-1]


def test_scenes_are_the_samples_or_the_users_or_both(sample, tmp_path, experiment):
    experiment = dataclasses.replace(experiment, sample=SMALL, samples=(("tabletop", 5), ("room", 5)))
    options = ExperimentOptions(output=tmp_path)
    assert [s.name for s in scenes_of(experiment, options)] == ["tabletop 5", "room 5"]
    given = ExperimentOptions(data=(sample.data,), output=tmp_path)
    assert [s.name for s in scenes_of(experiment, given)] == ["sample"]
    both = scenes_of(experiment, ExperimentOptions(data=(sample.data,), scenes=1, output=tmp_path, downscale=2.0))
    assert [(s.name, s.downscale) for s in both] == [("tabletop 5", 1.0), ("sample", 2.0)]
    single = dataclasses.replace(experiment, samples=(("tabletop", 5), ("tabletop", 6)), of_seed={6: {"num_points": 9}})
    planned = scenes_of(single, ExperimentOptions(output=tmp_path, plan=True))
    assert [scene.sample and scene.sample.num_points for scene in planned] == [300, 9]
    for wrong, words in [
        ({"scenes": 3}, "--scenes is 3"),
        ({"scenes": 0}, "no scene to train on"),
        ({"data": (sample.data, sample.data)}, "two of the given folders are called sample"),
    ]:
        with pytest.raises(UserError, match=words):
            scenes_of(experiment, ExperimentOptions(output=tmp_path, **wrong))
    assert given_scenes([sample.data], None)[0].downscale == 1.0


def test_quick_keeps_the_ends_of_sweeps_and_trains_a_few_steps(experiment):
    quick = adapted(experiment, ExperimentOptions(quick=True))
    assert [v.name for v in quick.variants] == [v.name for v in experiment.variants]  # two points a line are its ends
    longer = adapted(load_experiment("sensitivity"), ExperimentOptions(quick=True))
    assert [v.x for v in longer.variants if v.sweep] == [5.0, 5000.0, 1.0, 1000.0]
    compared = adapted(load_experiment("compare"), ExperimentOptions(quick=True))
    assert {v.refine[MODEL + "refine_steps"] for v in compared.variants} == {10, 30}
    trial = plan(quick, [scene()], masks_of(scene()), "code")[1].trial
    assert steps_of(trial) == 7 and steps_of(trial.base) < 300
    with pytest.raises(UserError, match="no preset 'beags-huge'"):
        adapted(experiment, ExperimentOptions(preset="beags-huge"))


def test_all_names_every_variant_unless_one_is_called_that():
    compared, ablation = load_experiment("compare"), load_experiment("ablation")
    assert adapted(compared, ExperimentOptions(variants=("all",))).variants == compared.variants
    assert adapted(compared, ExperimentOptions(variants=("flashsplat", "all"))).variants == compared.variants
    chosen = adapted(ablation, ExperimentOptions(variants=("all",))).variants
    assert [variant.name for variant in chosen] == ["assignment alone", "all"]
