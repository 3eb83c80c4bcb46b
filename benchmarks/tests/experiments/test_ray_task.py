"""What a node does for a trial, without Ray: where it works, what it asks for, what it sends back."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("nerfstudio")

import yaml

from beags_benchmarks.experiments.engines import ray_task, trial_folder
from beags_benchmarks.experiments.engines.interface import Needs
from beags_benchmarks.experiments.engines.parcels import pack, relocate, unpack
from beags_benchmarks.experiments.engines.ray_cluster import USUAL_CORES, share
from beags_benchmarks.experiments.engines.ray_task import TRAINED_FOLDER, Input, Task, perform
from beags_benchmarks.experiments.engines.trial_folder import SCORED, TRAINED
from beags_plugin.plugin.options.saved_config import load_run_config
from beags_plugin.plugin.presets import preset_config
from beags_plugin.system.digests import folder_digest
from beags_plugin.system.errors import UserError


class FakeWorker:
    """A worker that "trains" by copying the photo that it finds, and counts its runs."""

    code, fails = 0, ""

    def __init__(self) -> None:
        self.ran: list[tuple[str, str]] = []

    def run(self, folder: Path, until: str) -> int:
        request = json.loads((folder / "trial.json").read_text())
        self.ran.append((until, request["data"]))
        run = folder / "run/nerfstudio_models"
        run.mkdir(parents=True, exist_ok=True)
        config = preset_config("beags-tiny", {}, Path("t"))
        if (run.parent / "config.yml").exists():
            config = load_run_config(run.parent / "config.yml")
            assert config.data_config.dataparser.data == Path(request["data"]) and config.run_dir == run.parent
        config.data_config.dataparser.data, config.run_dir = Path(request["data"]), run.parent
        (run.parent / "config.yml").write_text(yaml.dump(config))
        (run / "step-000000001.ckpt").write_bytes((Path(request["data"]) / "photo.png").read_bytes())
        (folder / "log.txt").write_text("trained")
        if self.fails:
            (folder / "failed.json").write_text(json.dumps({"failed": self.fails}))
        if self.code == 0:
            (folder / f"{'trained' if until == TRAINED else 'result'}.json").write_text('{"steps": 3}')
        return self.code


@pytest.fixture
def worker(monkeypatch, tmp_path):
    """The worker of every node; nodes keep their own folders below ``tmp_path / "disk"``."""
    fake = FakeWorker()
    (tmp_path / "disk").mkdir()
    monkeypatch.setattr(ray_task, "_worker", lambda _: fake)
    monkeypatch.setattr(ray_task, "_code", lambda: "code")
    monkeypatch.setattr(ray_task.tempfile, "gettempdir", lambda: str(tmp_path / "disk"))
    return fake


@pytest.fixture
def task(tmp_path):
    """A function that makes the task of a refinement: its scene and base are on disk."""
    for name, content in {"scene/photo.png": b"photo", "trials/base/run/config": b"base"}.items():
        (tmp_path / name).parent.mkdir(parents=True)
        (tmp_path / name).write_bytes(content)
    (tmp_path / "trials/.shared").write_text("secret")

    def make(until=TRAINED, shared=True, sees=True, parcels=False, **more) -> Task:
        folders = {"data": tmp_path / "scene", "base": tmp_path / "trials/base/run"}
        inputs = {
            name: Input(str(path), folder_digest(path) + ("" if sees else "x"), pack(path) if parcels else None)
            for name, path in folders.items()
        }
        request = {**{name: str(path) for name, path in folders.items()}, "masks": None, "digest": "d"}
        mark = (str(tmp_path / "trials/.shared"), "secret" if shared else "of another disk")
        return Task(str(tmp_path / "trials/t"), mark, request, until, "code", {}, inputs, **more)

    return make


def same(parcel: bytes) -> bytes:
    return parcel


def test_a_node_that_shares_the_folder_works_in_it(tmp_path, worker, task):
    report, parcel = perform(task(), "node", same)
    assert parcel is None and report.shared and report.outcome.result == {"steps": 3}
    assert json.loads((tmp_path / "trials/t/trained.json").read_text()) == {"steps": 3}
    assert worker.ran == [(TRAINED, str(tmp_path / "scene"))]
    assert perform(task(), "node", same)[0].outcome.result == {"steps": 3} and len(worker.ran) == 1, "it is done"


def test_a_node_asks_for_what_it_does_not_see_and_keeps_it(tmp_path, worker, task):
    report, _ = perform(task(shared=False, sees=False), "node", same)
    assert report.lacks == ("data", "base") and report.outcome is None and not worker.ran
    fetched = []
    for _ in range(2):
        report, parcel = perform(task(shared=False, sees=False, parcels=True), "node", lambda p: fetched.append(p) or p)
    assert len(fetched) == 2, "photos and base, once"
    assert not (tmp_path / "trials/t").exists() and not list((tmp_path / "disk").glob("*/trials/t"))
    unpack(parcel, tmp_path / "back")
    assert (tmp_path / "back/run/nerfstudio_models/step-000000001.ckpt").read_bytes() == b"photo"
    config = load_run_config(tmp_path / "back/run/config.yml")
    assert config.data_config.dataparser.data == tmp_path / "scene" and config.run_dir == tmp_path / "trials/t/run"
    assert Path(worker.ran[0][1]).is_relative_to(tmp_path / "disk")
    (own,) = (tmp_path / "disk").iterdir()
    assert own.stat().st_mode & 0o777 == 0o700, "other users do not read it"
    ray_task.forget("node", dict.fromkeys(each.digest for each in task(sees=False).inputs.values()))
    assert not [path for path in (own / "inputs").iterdir() if path.is_dir()]


@pytest.mark.parametrize("shared", [False, True])
def test_scores_of_another_node_go_on_from_what_was_trained(tmp_path, worker, task, shared):
    """Neither node sees photos and base; the second one sees the trial's folder, or not."""
    _, trained = perform(task(TRAINED, shared=False, sees=False, parcels=True), "one", same)
    shutil.rmtree(next((tmp_path / "disk").glob("beags-*")))
    scores = task(SCORED, shared=shared, sees=False, parcels=True)
    assert perform(scores, "other", same)[0].lacks == (TRAINED_FOLDER,)
    report, parcel = perform(replace(scores, trained=trained), "other", same)
    assert [until for until, _ in worker.ran] == [TRAINED, SCORED] and report.outcome.result == {"steps": 3}
    if not shared:
        unpack(parcel, tmp_path / "trials/t")
    assert (tmp_path / "trials/t/trained.json").exists() and (tmp_path / "trials/t/result.json").exists()
    config = load_run_config(tmp_path / "trials/t/run/config.yml")
    assert config.data_config.dataparser.data == tmp_path / "scene" and config.run_dir == tmp_path / "trials/t/run"


def test_a_failure_comes_back_with_its_log(tmp_path, worker, task):
    worker.code, worker.fails = 1, "k is 0."
    report, parcel = perform(task(shared=False), "node", same)
    assert report.outcome.failed == "k is 0." and not report.outcome.killed
    unpack(parcel, tmp_path / "back")
    assert sorted(path.name for path in (tmp_path / "back").iterdir()) == ["failed.json", "log.txt", "trial.json"]


def test_a_killed_trial_goes_on_from_its_checkpoint(tmp_path, worker, task):
    worker.code = -9
    report, _ = perform(task(), "node", same)
    assert report.outcome.killed and "exit code -9" in report.outcome.failed
    kept = tmp_path / "trials/t/run/kept"
    kept.touch()
    worker.code = 0
    assert perform(task(), "other", same)[0].outcome.result == {"steps": 3} and kept.exists()
    other = task()
    (tmp_path / "trials/t/trained.json").unlink()
    other.request["digest"] = "e"
    perform(other, "node", same)
    assert not kept.exists(), "another trial begins anew"


def test_a_node_that_is_unfit_says_so(tmp_path, worker, task, monkeypatch):
    monkeypatch.setattr(ray_task, "_code", lambda: "other code")
    assert "another version of beags: install" in perform(task(), "node", same)[0].unfit
    monkeypatch.setattr(ray_task, "_code", lambda: "code")
    monkeypatch.setattr(ray_task, "free_disk_mb", lambda _: 3.0)
    assert "has 3 MB left: free some space" in perform(task(shared=False), "node", same)[0].unfit
    assert perform(task(), "node", same)[0].outcome.result, "the shared disk is another one"
    assert not list((tmp_path / "disk").glob("*/trials/t")) and len(worker.ran) == 1


def test_a_node_without_room_for_what_it_is_sent_is_left_out(worker, task, monkeypatch):
    def full(*_):
        raise UserError("inputs cannot be written (No space left on device): free some space.")

    monkeypatch.setattr(ray_task, "unpack", full)
    for shared in (False, True):
        report, _ = perform(task(shared=shared, sees=False, parcels=True), "node", same)
        assert report.unfit.startswith("inputs cannot be written") and not worker.ran


def test_a_trial_that_fills_the_disk_of_its_node_leaves_it(tmp_path, worker, task, monkeypatch):
    free = iter([5000.0, 3.0])
    monkeypatch.setattr(ray_task, "free_disk_mb", lambda _: next(free))
    worker.code, worker.fails = 1, "run cannot be written (No space left on device): free some space."
    report, parcel = perform(task(shared=False), "node", same)
    assert report.unfit.startswith("run cannot be written") and parcel is None and report.outcome is None
    assert not list((tmp_path / "disk").glob("*/trials/t"))


def test_a_trial_that_fills_the_shared_disk_is_named(worker, task, monkeypatch):
    monkeypatch.setattr(trial_folder, "free_disk_mb", lambda _: 3.0)
    worker.code = 1
    outcome = perform(task(), "node", same)[0].outcome
    assert "exit code 1; its disk has 3 MB left; " in outcome.failed and not outcome.killed


def test_configs_that_come_back_name_the_places_here(tmp_path):
    config = preset_config("beags-tiny", {}, Path("t"))
    config.run_dir, config.load_dir = Path("/node/trials/t/run"), Path("/node/inputs/b/nerfstudio_models")
    config.data_config.dataparser.data = Path("/node/inputs/d")
    config.data_config.dataparser.masks_path = Path("masks")  # relative to the data
    for folder in ("t/run", "t/run/base"):
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / folder / "config.yml").write_text(yaml.dump(config))
    places = {"/node/trials/t": tmp_path / "t", "/node/inputs/b": Path("/here/b"), "/node/inputs/d": Path("/here/d")}
    relocate(tmp_path / "t", {Path(there): here for there, here in places.items()})
    for folder in ("t/run", "t/run/base"):
        found = load_run_config(tmp_path / folder / "config.yml")
        assert (found.run_dir, found.load_dir) == (tmp_path / "t/run", Path("/here/b/nerfstudio_models"))
        parser = found.data_config.dataparser
        assert (parser.data, parser.masks_path) == (Path("/here/d"), Path("masks"))
        assert found.model_config == config.model_config


def test_a_task_asks_for_what_is_foretold_and_no_more_than_a_node_has():
    small, large = {"CPU": 2.0, "memory": 4e9}, {"CPU": 16.0, "memory": 64e9}
    gpus = {"CPU": 32.0, "GPU": 8.0, "memory": 100e9}
    known, unknown, huge = Needs(3, 2500.0), Needs(None, 2500.0), Needs(99, 1e6)
    assert share(known, [small, large]) == {"num_cpus": 3, "num_gpus": 0, "memory": 2_500_000_000}
    assert share(unknown, [large])["num_cpus"] == USUAL_CORES
    assert share(unknown, [small, large])["num_cpus"] == 2
    assert share(huge, [small, large]) == {"num_cpus": 16, "num_gpus": 0, "memory": 64_000_000_000}
    assert share(huge, [large, gpus]) == {"num_cpus": 4, "num_gpus": 1, "memory": 100_000_000_000}, "GPUs alone"
    assert share(known, [{"memory": 1e9}, {"CPU": 0.0}]) is None
