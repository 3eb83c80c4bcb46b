"""Engines by name, and trials that end in any order on an engine that has many at once."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

pytest.importorskip("nerfstudio")

from experiment_files import GOOD, scene, written

from beags_benchmarks.experiments.engines import ENGINES, make_engine
from beags_benchmarks.experiments.engines.interface import Engine, Job, Outcome
from beags_benchmarks.experiments.options import ExperimentOptions
from beags_benchmarks.experiments.run import run_experiment
from beags_benchmarks.experiments.runner import run_trials
from beags_benchmarks.experiments.trials import Trial
from beags_plugin.system.errors import UserError


class ManyAtOnce(Engine):
    """An engine on which the trial that began last ends first."""

    def __init__(self, address: str | None = None) -> None:
        self.running: list[Job] = []
        self.began: list[dict] = []
        self.most = 0

    def __enter__(self) -> ManyAtOnce:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def start(self, job: Job) -> None:
        self.running.append(job)
        self.began.append(job.request)
        self.most = max(self.most, len(self.running))

    def wait(self) -> tuple[Job, Outcome]:
        job = self.running.pop()
        if "fail" in job.request["overrides"]:
            return job, Outcome(job.folder, None, "k is 0.")
        result = {"overrides": job.request["overrides"]}
        job.folder.mkdir(parents=True)
        (job.folder / "result.json").write_text(json.dumps(result))
        return job, Outcome(job.folder, result)


def trials() -> list[Trial]:
    """Two trials from one base, one from another, and one from a base that fails."""
    bases = [Trial(scene(), "beags-tiny", own, 0, "code") for own in ({"b": 0}, {"b": 1}, {"fail": 1})]
    return [
        Trial(scene(), "beags-tiny", {"x": number}, 0, "code", base=bases[base])
        for number, base in enumerate((0, 0, 1, 2))
    ]


def run(folder: Path, engine: Engine, progress=None) -> list[Outcome]:
    wanted = trials()
    outcomes = run_trials(wanted, folder, lambda _: 1, engine, progress)
    bases = [trial.base.digest for trial in wanted]
    assert list(outcomes) == list(dict.fromkeys(d for t, b in zip(wanted, bases, strict=True) for d in (b, t.digest)))
    return [outcomes[trial.digest] for trial in wanted]


def test_trials_begin_once_their_base_has_ended_and_no_failure_stops_the_others(tmp_path):
    engine, reported = ManyAtOnce(), []
    outcomes = run(tmp_path, engine, lambda done, total: reported.append((done, total)))
    assert engine.most == 3, "the three bases, then what starts from them"
    assert [outcome.result and outcome.result["overrides"] for outcome in outcomes] == [
        {"x": 0},
        {"x": 1},
        {"x": 2},
        None,
    ]
    assert outcomes[3].result is None and outcomes[3].failed == "its base failed: k is 0."
    assert {str(request["base"]) for request in engine.began[3:]} == {
        str(tmp_path / trial.base.folder_name / "run") for trial in trials()[:3]
    }
    assert reported == [(done, 7) for done in range(1, 8)]


def test_what_is_done_is_not_given_to_an_engine_again(tmp_path):
    run(tmp_path, ManyAtOnce())
    engine = ManyAtOnce()
    again = run(tmp_path, engine)
    assert [request["overrides"] for request in engine.began] == [{"fail": 1}]
    assert [outcome.failed for outcome in again] == [None, None, None, "its base failed: k is 0."]


def test_engines_are_chosen_by_name_before_anything_is_made(tmp_path, monkeypatch):
    path = written(tmp_path, GOOD)
    for options, sentence in {
        ("locale", None): r"there is no engine 'locale' \(did you mean local\?\): choose one of local, ray\.",
        ("local", "auto"): "--address auto names a cluster: add --engine ray, or leave it out.",
    }.items():
        engine, address = options
        with pytest.raises(UserError, match=sentence):
            run_experiment(path, ExperimentOptions(engine=engine, address=address, output=tmp_path / "out"))
    monkeypatch.setitem(ENGINES._specs, "many", f"{__name__}:ManyAtOnce")
    monkeypatch.setattr(ManyAtOnce, "unavailable", classmethod(lambda _: "it lacks a part: install it."))
    with pytest.raises(UserError, match="it lacks a part: install it."):
        make_engine("many")
    assert not (tmp_path / "out").exists()
