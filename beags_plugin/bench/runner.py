"""The runner of trials: one after the other, each in a process of its own, with results that are kept."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from filelock import FileLock

from beags_plugin.bench.trials import Trial
from beags_plugin.system.child_processes import bound
from beags_plugin.system.errors import writing

Progress = Callable[[int, int], None]
PROGRAM = [sys.executable, "-m", "beags_plugin.bench.worker"]


@dataclass(frozen=True)
class Outcome:
    """The outcome of a trial: the content of result.json, or the reason of its failure in a sentence."""

    folder: Path
    result: dict[str, Any] | None
    failed: str | None = None


def run_trials(
    trials: Sequence[Trial], folder: Path, weight: Callable[[Trial], int], progress: Progress | None = None
) -> dict[str, Outcome]:
    """Run every trial, and its base before it, unless it is done; returns outcomes by digest.

    folder: holds a folder for each trial. weight: share of a trial in the progress, e.g. its number of steps. The
    other trials run although one fails. The next call runs again what failed or was interrupted.
    """
    queue = {trial.digest: trial for wanted in trials for trial in (wanted.base, wanted) if trial is not None}
    total = sum(weight(trial) for trial in queue.values())
    outcomes: dict[str, Outcome] = {}
    done = 0
    with Worker() as worker:
        for digest, trial in queue.items():
            base = outcomes[trial.base.digest] if trial.base is not None else None
            outcomes[digest] = _run(trial, folder / trial.folder_name, base, worker)
            done += weight(trial)
            if progress is not None:
                progress(done, total)
    return outcomes


def _run(trial: Trial, folder: Path, base: Outcome | None, worker: Worker) -> Outcome:
    if base is not None and base.failed is not None:
        return Outcome(folder, None, f"its base failed: {base.failed}")
    with writing(folder):
        folder.parent.mkdir(parents=True, exist_ok=True)
        lock = FileLock(folder.parent / f".{folder.name}.lock").acquire()
    with lock:  # the second of two programs that want the same trial waits, and finds it done
        if (result := _read(folder / "result.json")) is not None:
            return Outcome(folder, result)
        if folder.exists():
            shutil.rmtree(folder)  # left by an interrupted or failed trial
        request = {
            "preset": trial.preset,
            "data": str(trial.scene.data.absolute()),
            "downscale": trial.scene.downscale,
            "options": dict(trial.scene.options),
            "masks": None if trial.masks is None else str(trial.masks.absolute()),
            "base": None if base is None else str((base.folder / "run").absolute()),
            "seed": trial.seed,
            "overrides": dict(trial.overrides),
            "digest": trial.digest,
        }
        with writing(folder):
            folder.mkdir(parents=True)
            (folder / "trial.json").write_text(json.dumps(request, indent=1))
        code = worker.run(folder)
        if (result := _read(folder / "result.json")) is not None:
            return Outcome(folder, result)
        failed = _read(folder / "failed.json")
        reason = failed["failed"] if failed else f"it ended with exit code {code}; {folder / 'log.txt'} says more."
        return Outcome(folder, None, reason)


class Worker:
    """The program that runs trials, ``worker.serve``; the first trial starts it, leaving the context ends it."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[str] | None = None
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115  (of the program itself; trials have logs)

    def run(self, folder: Path) -> int:
        """Run the trial in ``folder``; returns the exit code of its process, negative for a signal."""
        if self._process is None:
            package = str(Path(__file__).resolve().parents[2])  # the worker imports this very package
            paths = os.pathsep.join(filter(None, [package, os.environ.get("PYTHONPATH")]))
            environment = {"OMP_WAIT_POLICY": "PASSIVE", **os.environ, "PYTHONPATH": paths, "COLUMNS": "160"}
            self._process = subprocess.Popen(
                bound(PROGRAM),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._errors,
                text=True,
                env=environment,
            )
        assert self._process.stdin is not None and self._process.stdout is not None
        try:
            print(folder.absolute(), file=self._process.stdin, flush=True)
            return int(self._process.stdout.readline())
        except (OSError, ValueError):  # the program itself is gone
            process, self._process = self._process, None
            process.stdin = None
            code = process.wait()
            self._errors.seek(0)
            with open(folder / "log.txt", "ab") as log:
                log.write(self._errors.read())
            return code

    def __enter__(self) -> Worker:
        return self

    def __exit__(self, *_: object) -> None:
        if self._process is not None:
            self._process.terminate()
            self._process.wait()
        self._errors.close()


def _read(path: Path) -> dict[str, Any] | None:
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError):
        return None
