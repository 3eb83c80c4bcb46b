"""The engine of many machines against a Ray that is made up: lost workers, unfit nodes, folders that are sent."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

pytest.importorskip("nerfstudio")

from experiment_files import GOOD, written

from beags_benchmarks.experiments.engines import make_engine, ray_cluster
from beags_benchmarks.experiments.engines.interface import Job, Needs, Outcome
from beags_benchmarks.experiments.engines.parcels import pack
from beags_benchmarks.experiments.engines.ray_cluster import MOST_ATTEMPTS, RayEngine
from beags_benchmarks.experiments.engines.ray_task import TRAINED_FOLDER, Report, Task
from beags_benchmarks.experiments.engines.trial_folder import SCORED, TRAINED
from beags_benchmarks.experiments.options import ExperimentOptions
from beags_benchmarks.experiments.run import run_experiment
from beags_benchmarks.experiments.scenes import TrialScene
from beags_benchmarks.experiments.trials import Trial
from beags_plugin.system.errors import UserError


class RayError(Exception):
    pass


class WorkerCrashedError(RayError):
    pass


class RayTaskError(RayError):
    cause = ValueError("no such thing\nand more")


class FakeRay:
    """Tasks end as soon as they are waited for, as ``answer(task, number)`` says."""

    exceptions = SimpleNamespace(RayError=RayError, RayTaskError=RayTaskError)

    def __init__(self, answer: Callable[[Task, int], Report | Exception | tuple[Report, bytes]]) -> None:
        self.answer = answer
        self.tasks: list[tuple[dict, Task]] = []
        self.sent: list[bytes] = []
        self.lives = {"one": True, "two": True}

    def is_initialized(self) -> bool:
        return True

    def nodes(self) -> list[dict]:
        resources = {"CPU": 4.0, "memory": 8e9}
        return [{"NodeID": node, "Alive": alive, "Resources": resources} for node, alive in self.lives.items()]

    def remote(self, **_):
        def options(**asked):
            def begin(task):
                self.tasks.append((asked, task))
                return ("report", len(self.tasks) - 1), ("parcel", len(self.tasks) - 1)

            return SimpleNamespace(remote=begin)

        return lambda _: SimpleNamespace(options=options)

    def wait(self, references, **_):
        return references[:1], references[1:]

    def get(self, reference):
        kind, number = reference
        if kind == "sent":
            return self.sent[number]
        found = self.answer(self.tasks[number][1], number)
        if isinstance(found, Exception):
            raise found
        report, parcel = found if isinstance(found, tuple) else (found, None)
        return report if kind == "report" else parcel

    def put(self, parcel):
        self.sent.append(parcel)
        return "sent", len(self.sent) - 1

    def cancel(self, *_, **__):
        raise RuntimeError("it has ended")


@pytest.fixture
def run(tmp_path, monkeypatch):
    """A function that runs a refinement by answers; returns its outcome and the made-up Ray."""
    (tmp_path / "scene").mkdir()
    (tmp_path / "scene/photo.png").write_bytes(b"photo")
    (tmp_path / "trials/base/run").mkdir(parents=True)
    said: list[str] = []
    monkeypatch.setattr(ray_cluster, "say", said.append)
    monkeypatch.setattr(ray_cluster.RayEngine, "_forget", lambda _: None)

    def run(answer) -> tuple[Outcome, FakeRay, list[str]]:
        fake = FakeRay(answer)
        monkeypatch.setitem(sys.modules, "ray", fake)
        scene = TrialScene("a", tmp_path / "scene", 1.0, "1")
        base = Trial(scene, "beags-tiny", {}, 0, "code")
        trial = Trial(scene, "beags-tiny", {"x": 1}, 0, "code", base=base)
        job = Job(0, trial, tmp_path / "trials/t", tmp_path / "trials/base", Needs(2, 2000.0))
        with RayEngine(None) as engine:
            engine.start(job)
            found, outcome = engine.wait()
            assert found is job
        return outcome, fake, said

    return run


def ended(task: Task, **more) -> Report:
    return Report("one", "host", Outcome(Path(task.folder), {"until": task.until}), **more)


def test_training_and_scoring_are_a_task_each(run, monkeypatch):
    monkeypatch.setenv("BEAGS_ISA", "sse2")
    outcome, fake, _ = run(lambda task, _: ended(task))
    assert [task.until for _, task in fake.tasks] == [TRAINED, SCORED] and outcome.result == {"until": SCORED}
    asked, task = fake.tasks[0]
    assert asked == {"name": "trained t", "num_cpus": 2, "num_gpus": 0, "memory": 2_000_000_000}
    assert set(task.inputs) == {"data", "base"} and task.code == "code" and not fake.sent
    assert task.environment["BEAGS_ISA"] == "sse2" and task.environment["OMP_NUM_THREADS"] == "2"


def test_a_lost_worker_is_replaced_a_few_times(run):
    outcome, fake, said = run(lambda task, number: WorkerCrashedError() if number in (0, 2) else ended(task))
    assert outcome.result and [task.until for _, task in fake.tasks] == [TRAINED] * 2 + [SCORED] * 2
    assert said == ["t: its worker was lost (WorkerCrashedError); it is started again."] * 2
    outcome, fake, _ = run(lambda task, _: WorkerCrashedError())
    assert outcome.failed == "its worker was lost (WorkerCrashedError), the last of 4 attempts"
    assert len(fake.tasks) == MOST_ATTEMPTS
    killed = Outcome(Path("t"), None, "it ended with exit code -9; log.txt says more.", killed=True)
    outcome, fake, _ = run(lambda *_: Report("one", "host", killed))
    assert outcome.failed.startswith("on host it ended with exit code -9") and len(fake.tasks) == MOST_ATTEMPTS


def test_a_trial_that_fails_by_itself_is_not_repeated(run):
    for answer, reason in {
        lambda task, _: Report("one", "host", Outcome(Path(task.folder), None, "k is 0.")): "k is 0.",
        lambda task, _: RayTaskError(): "its task failed: no such thing",
    }.items():
        outcome, fake, _ = run(answer)
        assert outcome.failed == reason and len(fake.tasks) == 1


def test_what_was_trained_is_trained_again_only_if_it_is_lost(run, tmp_path):
    class TaskLacksObject(RayTaskError):
        cause = WorkerCrashedError("the node that held it is gone")

    def answer(task, number):
        return TaskLacksObject() if number == 1 else ended(task, shared=False)

    outcome, fake, said = run(answer)
    assert [task.until for _, task in fake.tasks] == [TRAINED, SCORED, TRAINED, SCORED] and outcome.result
    assert said == ["t: what it needs was lost; it is started again."]
    (tmp_path / "trials/t").mkdir()
    (tmp_path / "trials/t/trained.json").write_text("{}")

    def lacking(task, number):
        return Report("one", "host", lacks=(TRAINED_FOLDER,)) if number == 0 else ended(task)

    outcome, fake, _ = run(lacking)
    assert [task.until for _, task in fake.tasks] == [SCORED, SCORED] and fake.tasks[1][1].trained == ("sent", 0)


def test_an_unfit_node_is_left_out_and_without_others_the_trial_fails(run):
    def answer(task, number):
        return Report("one", "host", unfit="its disk is full") if number == 0 else ended(task)

    outcome, fake, said = run(answer)
    assert outcome.result and said == ["A node is left out: its disk is full"]
    assert "label_selector" not in fake.tasks[0][0]
    assert [asked["label_selector"] for asked, _ in fake.tasks[1:]] == [{"ray.io/node-id": "!in(one)"}] * 2
    both = iter(("one", "two"))
    outcome, fake, _ = run(lambda *_: Report(next(both), "host", unfit="its disk is full"))
    assert outcome.failed == "no node of the cluster can run it; of the last one: its disk is full"


def test_what_a_node_lacks_is_packed_once_and_its_folder_comes_back(run, tmp_path):
    made = tmp_path / "node/t"
    (made / "run").mkdir(parents=True)
    (made / "run/scene").write_bytes(b"scene")

    def answer(task, number):
        if number in (0, 2):  # a node that has seen nothing yet
            lacks = [name for name, each in task.inputs.items() if each.parcel is None]
            return Report("one", "host", lacks=tuple(lacks)) if lacks else ended(task, shared=False)
        return ended(task, shared=False), pack(made)

    outcome, fake, _ = run(answer)
    assert [task.until for _, task in fake.tasks] == [TRAINED, TRAINED, SCORED]
    assert len(fake.sent) == 2 and all(each.parcel for each in fake.tasks[1][1].inputs.values())
    assert fake.tasks[2][1].trained == ("parcel", 1), "it goes from node to node"


def test_a_folder_that_does_not_fit_on_this_disk_is_a_reason(run, monkeypatch):
    def full(*_):
        raise UserError("t cannot be written (No space left on device): free some space.")

    monkeypatch.setattr(ray_cluster, "unpack", full)
    outcome, _, _ = run(lambda task, _: (ended(task, shared=False), b"parcel"))
    assert outcome.failed.startswith("t cannot be written") and outcome.result is None


def test_without_ray_or_its_cluster_there_is_one_sentence(tmp_path, monkeypatch):
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "ray" else find(name))
    options = ExperimentOptions(output=tmp_path / "out", engine="ray")
    with pytest.raises(UserError, match=r"the engine ray needs Ray: pip install 'ray>=2\.50'\."):
        run_experiment(written(tmp_path, GOOD), options)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object() if name == "ray" else find(name))

    fake = FakeRay(lambda *_: None)
    fake.is_initialized = lambda: False
    monkeypatch.setitem(sys.modules, "ray", fake)
    with pytest.raises(UserError, match=r"there is no Ray cluster at 127\.0\.0\.1:1 \(.*refused\): start one") as error:
        make_engine("ray", "127.0.0.1:1").__enter__()
    assert "\n" not in str(error.value) and not (tmp_path / "out").exists()

    def init(**_):
        raise RuntimeError("The node timed out during startup.\nand more")

    fake.init = init
    with pytest.raises(UserError, match=r"Ray cannot start on this machine \(The node timed out during startup\.\)"):
        make_engine("ray").__enter__()
