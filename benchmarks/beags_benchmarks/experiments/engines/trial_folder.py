"""One trial in its folder: begun, run by a program of its own, and its outcome read; the same for every engine."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext, suppress
from pathlib import Path
from types import MappingProxyType
from typing import IO, Any

from filelock import FileLock

from beags_benchmarks.experiments.engines.interface import Outcome
from beags_benchmarks.provenance import with_these_packages
from beags_plugin.plugin.training.memory_guard import LEAST_FREE_MB, free_disk_mb
from beags_plugin.system.child_processes import bound
from beags_plugin.system.errors import writing
from beags_plugin.system.lock import LOCK
from beags_plugin.system.whole_files import write_text_atomically

PROGRAM = [sys.executable, "-m", "beags_benchmarks.experiments.worker"]
TRAINED, SCORED = "trained", "scored"
"""How far to run a trial: until its training ends, or to the scores of its refinement."""
INTERRUPTED = 128 + signal.SIGTERM
"""Exit code of a trial that SIGTERM ended after it saved its training."""
_PATIENCE = 60.0  # seconds for a training whose program was killed, to save and end


def run_in_folder(folder: Path, request: dict[str, Any], worker: Worker, until: str = SCORED) -> Outcome:
    """Run the trial that ``request`` describes (``Job.request``), unless it is done, and return its outcome.

    until: ``SCORED``, or ``TRAINED``; the result is then only that of the training. An attempt that a kill or a power
    cut ended goes on from what it saved. Raises ``UserError`` where nothing can be written.
    """
    content = folder / f"{'trained' if until == TRAINED and request['base'] is not None else 'result'}.json"
    with writing(folder):
        folder.parent.mkdir(parents=True, exist_ok=True)
        lock = _lock(folder.parent / f".{folder.name}.lock")
    with lock:  # the second of two programs that want the same trial waits, and finds it done
        if (result := finished(folder) or read_json(content)) is not None:
            return Outcome(folder, result)
        if _goes_on(folder, request):
            _wait_for_end(folder / "run")
            (folder / "failed.json").unlink(missing_ok=True)
        elif folder.exists():
            with writing(folder):
                shutil.rmtree(folder)  # left by an interrupted or failed trial
        write_text_atomically(json.dumps(request, indent=1), folder / "trial.json")
        code = worker.run(folder, until)
        if (result := read_json(content)) is not None:
            return Outcome(folder, result)
        if (failed := read_json(folder / "failed.json")) is not None:
            return Outcome(folder, None, failed["failed"])
        full = f"; its disk has {free:.0f} MB left" if (free := free_disk_mb(folder)) < LEAST_FREE_MB else ""
        reason = f"it ended with exit code {code}{full}; {folder / 'log.txt'} says more."
        return Outcome(folder, None, reason, killed=(code < 0 or code == INTERRUPTED) and not full)


def _lock(path: Path) -> AbstractContextManager[object]:
    """Wait for a lock and hold it; lock nothing on disks without locks, such as some network disks."""
    try:
        return FileLock(path).acquire()
    except NotImplementedError:
        return nullcontext()
    except OSError as error:
        if error.filename is not None:  # the named file cannot be opened
            raise
        return nullcontext()


def _goes_on(folder: Path, request: dict[str, Any]) -> bool:
    """Return whether the folder holds an interrupted or trained attempt at this trial.

    An interrupted training continues only for the same request. A finished one is scored, even if its folder has moved.
    """
    former = read_json(folder / "trial.json") or {}
    if (folder / "trained.json").exists():
        return former.get("digest") == request["digest"]
    saved = any((folder / "run" / "nerfstudio_models").glob("step-*.ckpt"))
    return saved and former == json.loads(json.dumps(request)) and not (folder / "failed.json").exists()


def _wait_for_end(run: Path) -> None:
    """Wait for a training that is still saving after its parent was killed."""
    if (run / LOCK).exists():
        with suppress(OSError):  # a Timeout is an OSError too; the training itself reports the lock
            FileLock(run / LOCK).acquire(timeout=_PATIENCE).lock.release()


def finished(folder: Path) -> dict[str, Any] | None:
    """Return the result of the trial in ``folder``; None if it has none."""
    return read_json(folder / "result.json")


def read_json(path: Path) -> dict[str, Any] | None:
    """Return the content of a JSON file ; None if there is no valid one."""
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError):
        return None


class Worker:
    """The program that runs trials, ``worker.serve``: the first trial starts it, ``end`` ends it.

    environment: variables that are added to those of this process.
    """

    def __init__(self, environment: Mapping[str, str] = MappingProxyType({})) -> None:
        self._environment = environment
        self._process: subprocess.Popen[str] | None = None
        self._errors: IO[bytes] | None = None  # errors of the program itself; trials have logs

    def run(self, folder: Path, until: str = SCORED) -> int:
        """Run the trial in ``folder`` (see ``run_in_folder``); returns its exit code, negative for a signal."""
        if self._process is None:
            environment = {"OMP_WAIT_POLICY": "PASSIVE", **os.environ, **self._environment, "COLUMNS": "160"}
            self._errors = tempfile.TemporaryFile()  # noqa: SIM115
            self._process = subprocess.Popen(
                bound(PROGRAM),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._errors,
                text=True,
                env=with_these_packages(environment),
            )
        assert self._process.stdin is not None and self._process.stdout is not None and self._errors is not None
        try:
            print(until, folder.absolute(), file=self._process.stdin, flush=True)
            return int(self._process.stdout.readline())
        except (OSError, ValueError):  # the program itself has ended
            process, self._process = self._process, None
            process.stdin = None
            code = process.wait()
            self._errors.seek(0)
            with open(folder / "log.txt", "ab") as log:
                log.write(self._errors.read())
            self._errors.close()
            return code

    def end(self) -> None:
        """End the program and the trial that it runs."""
        if self._process is not None and self._errors is not None:
            self._process.terminate()
            self._process.wait()
            self._errors.close()
            self._process = None
