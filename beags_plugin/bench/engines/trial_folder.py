"""One trial in its folder: begun, run by a program of its own, and its outcome read; the same for every engine."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import IO, Any

from filelock import FileLock

from beags_plugin.bench.engines.interface import Outcome
from beags_plugin.system.child_processes import bound
from beags_plugin.system.errors import writing

PROGRAM = [sys.executable, "-m", "beags_plugin.bench.worker"]


def run_in_folder(folder: Path, request: dict[str, Any], worker: Worker) -> Outcome:
    """Run the trial that ``request`` describes (``Job.request``), unless it is done, and return its outcome.

    Raises ``UserError`` where nothing can be written.
    """
    with writing(folder):
        folder.parent.mkdir(parents=True, exist_ok=True)
        lock = FileLock(folder.parent / f".{folder.name}.lock").acquire()
    with lock:  # the second of two programs that want the same trial waits, and finds it done
        if (result := finished(folder)) is not None:
            return Outcome(folder, result)
        if folder.exists():
            shutil.rmtree(folder)  # left by an interrupted or failed trial
        with writing(folder):
            folder.mkdir(parents=True)
            (folder / "trial.json").write_text(json.dumps(request, indent=1))
        code = worker.run(folder)
        if (result := finished(folder)) is not None:
            return Outcome(folder, result)
        failed = read_json(folder / "failed.json")
        reason = failed["failed"] if failed else f"it ended with exit code {code}; {folder / 'log.txt'} says more."
        return Outcome(folder, None, reason)


def finished(folder: Path) -> dict[str, Any] | None:
    """Return the result of the trial in ``folder``; None if it has not finished well."""
    return read_json(folder / "result.json")


def read_json(path: Path) -> dict[str, Any] | None:
    """Return the content of a JSON file that was written whole; None if there is none."""
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError):
        return None


class Worker:
    """The program that runs trials, ``worker.serve``; the first trial starts it, ``end`` ends it."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[str] | None = None
        self._errors: IO[bytes] | None = None  # of the program itself; trials have logs

    def run(self, folder: Path) -> int:
        """Run the trial in ``folder``; returns the exit code of its process, negative for a signal."""
        if self._process is None:
            package = str(Path(__file__).resolve().parents[3])  # the worker imports this very package
            paths = os.pathsep.join(filter(None, [package, os.environ.get("PYTHONPATH")]))
            environment = {"OMP_WAIT_POLICY": "PASSIVE", **os.environ, "PYTHONPATH": paths, "COLUMNS": "160"}
            self._errors = tempfile.TemporaryFile()  # noqa: SIM115
            self._process = subprocess.Popen(
                bound(PROGRAM),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._errors,
                text=True,
                env=environment,
            )
        assert self._process.stdin is not None and self._process.stdout is not None and self._errors is not None
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
            self._errors.close()
            return code

    def end(self) -> None:
        """End the program and the trial that it runs."""
        if self._process is not None and self._errors is not None:
            self._process.terminate()
            self._process.wait()
            self._errors.close()
            self._process = None
