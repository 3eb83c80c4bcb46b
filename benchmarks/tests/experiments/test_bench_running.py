"""Trials run once, resume after an interruption, and report why they failed."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

pytest.importorskip("nerfstudio")

from experiment_files import scene

from beags_benchmarks.experiments.engines import local, trial_folder
from beags_benchmarks.experiments.engines.local import LocalEngine
from beags_benchmarks.experiments.runner import run_trials
from beags_benchmarks.experiments.trials import Trial


class FakeWorker:
    """A worker that writes results without training, and fails where the overrides ask for it."""

    def __init__(self) -> None:
        self.ran: list[dict] = []
        self.interrupt_at = -1
        self.saves = False

    def end(self):
        pass

    def run(self, folder: Path, until: str) -> int:
        request = json.loads((folder / "trial.json").read_text())
        if len(self.ran) == self.interrupt_at:
            (folder / "half").write_text("done")
            if self.saves:
                (folder / "run/nerfstudio_models").mkdir(parents=True)
                (folder / "run/nerfstudio_models/step-000000007.ckpt").touch()
            raise KeyboardInterrupt
        self.ran.append(request)
        if "fail" in request["overrides"]:
            (folder / "failed.json").write_text('{"failed": "k is 0."}')
            return 1
        if "die" in request["overrides"]:
            return -9
        (folder / "result.json").write_text(json.dumps({"digest": request["digest"]}))
        return 0


@pytest.fixture
def worker(monkeypatch):
    fake = FakeWorker()
    monkeypatch.setattr(local, "Worker", lambda: fake)
    return fake


def trials(*overrides: dict) -> list[Trial]:
    base = Trial(scene(), "beags-tiny", {"base": True}, 0, "code")
    return [Trial(scene(), "beags-tiny", own, 0, "code", base=base) for own in overrides]


def run(wanted: list[Trial], folder: Path, progress: Callable[[int, int], None] | None = None):
    with LocalEngine(None) as engine:
        return run_trials(wanted, folder, lambda _: 1, engine, progress)


def test_an_interrupted_experiment_resumes(tmp_path, worker):
    wanted = trials({"x": 1}, {"x": 2}, {"x": 3})
    worker.interrupt_at = 2  # the base, the first, and then no more
    with pytest.raises(KeyboardInterrupt):
        run(wanted, tmp_path)
    worker.interrupt_at = -1
    reported = []
    outcomes = run(wanted, tmp_path, lambda done, total: reported.append((done, total)))
    assert [request["overrides"] for request in worker.ran] == [{"base": True}, {"x": 1}, {"x": 2}, {"x": 3}]
    assert reported == [(1, 4), (2, 4), (3, 4), (4, 4)]
    for trial in wanted:
        outcome = outcomes[trial.digest]
        assert outcome.failed is None and outcome.result == {"digest": trial.digest}
        assert not (outcome.folder / "half").exists()
    assert worker.ran[1]["base"] == str(outcomes[wanted[0].base.digest].folder / "run")


def test_an_interrupted_trial_that_saved_goes_on_unless_it_is_another_one(tmp_path, worker):
    wanted = trials({"x": 1})
    worker.interrupt_at, worker.saves = 1, True
    with pytest.raises(KeyboardInterrupt):
        run(wanted, tmp_path)
    worker.interrupt_at = -1
    folder = run(wanted, tmp_path)[wanted[0].digest].folder
    assert (folder / "half").exists() and (folder / "result.json").exists()
    (folder / "result.json").unlink()
    (folder / "trial.json").write_text("{}")
    run(wanted, tmp_path)
    assert not (folder / "half").exists() and (folder / "result.json").exists()


@pytest.mark.parametrize("error", [NotImplementedError(), OSError(37, "No locks available")])
def test_a_disk_without_locks_is_no_obstacle(tmp_path, worker, monkeypatch, error):
    def acquire(*_, **__):
        raise error

    monkeypatch.setattr(trial_folder.FileLock, "acquire", acquire)
    wanted = trials({"x": 1})
    assert run(wanted, tmp_path)[wanted[0].digest].failed is None and len(worker.ran) == 2


def test_a_failed_trial_has_a_reason_and_is_tried_again(tmp_path, worker):
    wanted = trials({"fail": 1}, {"x": 1}, {"die": 1})
    for _ in range(2):
        outcomes = run(wanted, tmp_path)
        assert [outcomes[trial.digest].failed for trial in wanted[:2]] == ["k is 0.", None]
        assert "exit code -9" in outcomes[wanted[2].digest].failed
    assert len(worker.ran) == 4 + 2


def test_a_failed_base_fails_what_starts_from_it(tmp_path, worker):
    base = Trial(scene(), "beags-tiny", {"fail": 1}, 0, "code")
    refined = Trial(scene(), "beags-tiny", {"x": 1}, 0, "code", base=base)
    outcome = run([refined], tmp_path)[refined.digest]
    assert outcome.failed == "its base failed: k is 0." and len(worker.ran) == 1


def test_a_program_that_cannot_start_leaves_its_complaint_in_the_log(tmp_path, monkeypatch):
    complaint = "import sys; sys.exit('no such preset')"
    monkeypatch.setattr(trial_folder, "PROGRAM", [sys.executable, "-c", complaint])
    worker = trial_folder.Worker()
    for trial in ("a", "b"):  # it is started anew for the next one
        (tmp_path / trial).mkdir()
        assert worker.run(tmp_path / trial) == 1
        assert "no such preset" in (tmp_path / trial / "log.txt").read_text()
    worker.end()


@pytest.mark.skipif(sys.platform != "linux", reason="the kernel ends a program with its parent on Linux alone")
def test_the_program_that_runs_trials_ends_with_a_killed_bench(tmp_path):
    waiting = "import os, sys, time; open('pid', 'w').write(str(os.getpid()) + ' '); time.sleep(600)"
    bench = (
        "from pathlib import Path; from beags_benchmarks.experiments.engines import trial_folder; "
        f"trial_folder.PROGRAM = {[sys.executable, '-c', waiting]!r}; trial_folder.Worker().run(Path('.'))"
    )
    process = subprocess.Popen([sys.executable, "-c", bench], cwd=tmp_path)
    started = tmp_path / "pid"
    assert _within(60.0, lambda: started.exists() and started.read_text().endswith(" "))
    process.kill()
    process.wait()
    assert _within(60.0, lambda: not _runs(int(started.read_text())))


def _within(seconds: float, holds: Callable[[], bool]) -> bool:
    for _ in range(int(seconds / 0.05)):
        if holds():
            return True
        time.sleep(0.05)
    return False


def _runs(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


_WITH_A_GPU = """
from beags_benchmarks.experiments import worker
worker.GPU_FILES = ("/",)
worker._in_child = lambda *_: 9  # in a process that is only forked
worker.serve()
"""


@pytest.mark.slow("starts a trial in a process of its own")
def test_where_there_is_a_gpu_a_trial_imports_for_itself(tmp_path):
    """Imports start CUDA there, and a process that is forked after that cannot use it."""
    (tmp_path / "trial.json").write_text("{")
    done = subprocess.run(
        [sys.executable, "-c", _WITH_A_GPU], input=f"scored {tmp_path}\n", capture_output=True, text=True, check=True
    )
    assert done.stdout == "1\n"
    assert "JSONDecodeError" in (tmp_path / "log.txt").read_text()
