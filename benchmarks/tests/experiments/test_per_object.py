"""Variants with a training for each object: their trials, and one result of them all."""

import pytest

pytest.importorskip("nerfstudio")

from run_folders import write_scene

from beags_benchmarks.experiments.experiment import load_experiment
from beags_benchmarks.experiments.per_object import merged, object_names
from beags_benchmarks.experiments.scenes import TrialScene
from beags_benchmarks.experiments.trials import OPTIONS, plan
from beags_plugin.evaluation.records import FIGURES, IMAGE_FIGURES

FILE = """
description = "Each object alone."
preset = "beags-tiny"

[[variant]]
name = "all at once"

[[variant]]
name = "one by one"
per_object = true
[variant.refine]
"pipeline.model.refiner_options" = { gamma = 0.2 }
"""


def test_a_trial_for_each_object(tmp_path):
    scene = TrialScene("scene", write_scene(tmp_path / "data"), 1.0, "digest")
    path = tmp_path / "each.toml"
    path.write_text(FILE)
    together, apart = plan(load_experiment(str(path)), [scene], {}, "code")
    names = object_names(scene)
    assert len(names) == 2 and apart.objects == tuple(names) and not together.objects
    assert len(together.trials) == 1 and OPTIONS not in together.trial.overrides
    assert [trial.overrides[OPTIONS] for trial in apart.trials] == [{"gamma": 0.2, "object": name} for name in names]
    assert len({trial.digest for trial in (*together.trials, *apart.trials)}) == 3
    assert {trial.base.digest for trial in apart.trials} == {together.trial.base.digest}


def result(own: float, other: float, masks: list[tuple[str, float]], **figures) -> dict:
    """Return the result of a scene in which "cup" has the BIoU ``own``, and "box" ``other``."""

    def of(value):
        return {
            kind: {stage: dict.fromkeys(names, value) for stage in ("before", "after")}
            for kind, names in FIGURES.items()
        }

    rows = [
        {"kind": kind, "object": name, **{stage: dict.fromkeys(names, value) for stage in ("before", "after")}}
        for kind, names in FIGURES.items()
        for name, value in masks
    ]
    images = {name: {"before": 30.0, "after": figures["psnr"]} for name in IMAGE_FIGURES}
    evaluation = {"objects": {"cup": of(own), "box": of(other)}, "masks": rows, "mean": of(0.0), **images}
    costs = {name: figures[name] for name in ("cpu_seconds", "steps", "gaussians", "peak_memory_mb", "own_memory_mb")}
    return {"evaluation": evaluation, "seconds": {"refinement": 2.0}, **costs}


def test_results_of_single_objects_as_one():
    costs = {"cpu_seconds": 5.0, "steps": 40, "peak_memory_mb": 900.0, "own_memory_mb": 90.0}
    cup = result(0.9, 0.1, [("cup", 0.8), ("cup", 1.0), ("box", 0.1)], psnr=20.0, gaussians=100, **costs)
    box = result(0.2, 0.6, [("cup", 0.2), ("box", 0.6)], psnr=30.0, gaussians=80, **{**costs, "peak_memory_mb": 800.0})
    found = merged({"cup": cup, "box": box})
    objects, mean = found["evaluation"]["objects"], found["evaluation"]["mean"]
    assert objects["cup"]["extracted"]["after"]["biou"] == 0.9 and objects["box"]["rendered"]["after"]["iou"] == 0.6
    assert mean["extracted"]["after"]["biou"] == pytest.approx((0.8 + 1.0 + 0.6) / 3), "the mean over masks"
    assert found["evaluation"]["psnr"] == {"before": 30.0, "after": 25.0}
    assert (found["cpu_seconds"], found["steps"], found["gaussians"]) == (10.0, 80, 90)
    assert (found["peak_memory_mb"], found["seconds"]) == (900.0, {"refinement": 4.0})
