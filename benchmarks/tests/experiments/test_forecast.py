"""What a trial is expected to take, for the cluster that runs it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

pytest.importorskip("nerfstudio")

from experiment_files import scene

from beags_benchmarks.experiments.engines.interface import Needs
from beags_benchmarks.experiments.experiment import Variant
from beags_benchmarks.experiments.forecast import PIXEL_BYTES, PROGRAM_MB, Forecast
from beags_benchmarks.experiments.plan_table import plan_lines
from beags_benchmarks.experiments.scenes import SceneSize
from beags_benchmarks.experiments.trials import Trial, VariantTrial

SMALL, LARGE = scene("small", "1"), scene("large", "2")
SIZES = {"small": SceneSize(10, 1_000_000), "large": SceneSize(30, 3_000_000)}


def runs(variants: int = 1) -> list[VariantTrial]:
    """Return refinements of both scenes; each scene has one base."""
    found = []
    for each in (SMALL, LARGE):
        base = Trial(each, "beags-tiny", {"steps": 9}, 0, "code")
        for number in range(variants):
            trial = Trial(each, "beags-tiny", {"x": number}, 0, "code", base=base)
            found.append(VariantTrial(Variant(f"v{number}"), each, 0, (trial,)))
    return found


def finish(folder: Path, trial: Trial, cpu_seconds: float | None) -> None:
    result = {"seconds": {"a": 60.0, "b": 40.0}, "cpu_seconds": cpu_seconds, "peak_memory_mb": 900.0}
    (folder / trial.folder_name).mkdir(parents=True)
    (folder / trial.folder_name / "result.json").write_text(json.dumps({**result, "own_memory_mb": 100.0}))


def test_needs_are_those_of_finished_trials_of_the_kind_and_grow_with_the_pixels(tmp_path):
    small, large = runs()
    forecast = Forecast([small, large], SIZES, tmp_path)
    assert forecast.needs(large.trial) == Needs(None, PROGRAM_MB + 3 * PIXEL_BYTES)
    finish(tmp_path, small.trial, 260.0)
    assert forecast.needs(small.trial) == Needs(3, 900.0), "2.6 cores"
    assert forecast.needs(large.trial) == Needs(3, 900.0 + 2 * 100.0), "it has finished since"
    assert forecast.needs(large.trial.base).cores is None, "a base is of another kind"
    finish(tmp_path, small.trial.base, None)
    assert forecast.needs(large.trial.base) == Needs(None, 1100.0), "it was interrupted"


def test_bases_with_other_options_are_another_kind(tmp_path):
    (small, large) = runs()
    other = Trial(LARGE, "beags-tiny", {"steps": 30_000}, 0, "code")
    large = VariantTrial(large.variant, LARGE, 0, (Trial(LARGE, "beags-tiny", {"x": 0}, 0, "code", base=other),))
    finish(tmp_path, small.trial.base, 100.0)
    forecast = Forecast([small, large], SIZES, tmp_path)
    assert forecast.needs(other).memory_mb == PROGRAM_MB + 3 * PIXEL_BYTES
    first, second = forecast.scenes({"small": "The small one"})
    assert (first.title, first.trials, first.done, first.unknown) == ("The small one", 2, 1, ("v0",))
    assert (second.title, second.trials, second.done, second.unknown) == ("large", 2, 0, ("base", "v0"))


def test_a_line_names_a_few_of_many_unknown_kinds(tmp_path):
    lines = plan_lines(Forecast(runs(9), SIZES, tmp_path).scenes(), "--scenes 1")
    assert lines[0] == "20 trials, 20 of them not done."
    assert lines[1].startswith("Hours, memory and disk of base, v0, v1, v2, v3, v4 and 4 more are known once")
