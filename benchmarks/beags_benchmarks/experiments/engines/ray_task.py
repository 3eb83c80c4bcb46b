"""Tasks on a node of a Ray cluster: training a trial, or scoring a trained one.

A node works in the trial's folder if it shares that of the command, else in a folder of its own, whose content it
returns. Photos, masks and bases that it does not see are sent to it once. Configs of runs hold the paths of the command
while no task uses them.
"""

from __future__ import annotations

import os
import shutil
import socket
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from filelock import FileLock

from beags_benchmarks.experiments.engines.interface import Outcome
from beags_benchmarks.experiments.engines.parcels import pack, relocate, unpack
from beags_benchmarks.experiments.engines.trial_folder import SCORED, Worker, run_in_folder
from beags_benchmarks.experiments.trials import code_of_trials
from beags_plugin.plugin.training.memory_guard import LEAST_FREE_MB, free_disk_mb
from beags_plugin.system.digests import folder_digest
from beags_plugin.system.errors import UserError, writing

FOLDERS = ("data", "masks", "base")
"""Entries of a trial's request that name folders which the trial reads."""
TRAINED_FOLDER = "trained folder"
"""Name, among missing inputs, of the folder that another node trained."""
_OF_FAILURES = ("failed.json", "log.txt", "trial.json")


@dataclass(frozen=True)
class Input:
    """A folder that a trial reads. path: its path for the command. digest: its ``folder_digest``.

    parcel: a reference to its bytes; None until a node lacks it.
    """

    path: str
    digest: str
    parcel: Any = None


@dataclass(frozen=True)
class Task:
    """One step of a trial, for one node.

    folder: path of the trial for the command. mark: a file beside it and its content: a node that reads the same
    content shares the folder. request: ``Job.request``. until: ``TRAINED`` or ``SCORED``. code: digest of the command's
    code. environment: variables of the trial. inputs: by name in the request. trained: reference to the bytes of the
    trained folder, if another node trained it on its own disk.
    """

    folder: str
    mark: tuple[str, str]
    request: Mapping[str, Any]
    until: str
    code: str
    environment: Mapping[str, str]
    inputs: Mapping[str, Input]
    trained: Any = None


@dataclass(frozen=True)
class Report:
    """The end of a task.

    node, host: where it ran. outcome: None if it was not done: ``lacks`` then names inputs to send, or ``unfit`` is a
    sentence on why this node can run no task. shared: whether the files are in the trial's folder.
    """

    node: str
    host: str
    outcome: Outcome | None = None
    lacks: tuple[str, ...] = ()
    unfit: str | None = None
    shared: bool = True


def perform(task: Task, node: str, fetch: Callable[[Any], bytes]) -> tuple[Report, bytes | None]:
    """Run the task; returns its report and, if the trial's folder is not shared, the folder's bytes.

    node: id of the node in its cluster. fetch: returns the bytes of a reference.
    """
    host = socket.gethostname()
    if _code() != task.code:
        return Report(node, host, unfit=f"{host} has another version of beags: install the same wheel there."), None
    shared = _reads(*task.mark)
    try:
        own = _own_folder(node)
        folder = Path(task.folder) if shared else own / "trials" / Path(task.folder).name
        if not shared and (free := free_disk_mb(own)) < LEAST_FREE_MB:
            raise UserError(f"the disk of {own} has {free:.0f} MB left: free some space.")
        places = {name: _place(each, own / "inputs", fetch) for name, each in task.inputs.items()}
        lacks = [name for name, place in places.items() if place is None]
        if task.until == SCORED and task.request["base"] is not None and not (folder / "trained.json").exists():
            if task.trained is None:
                lacks.append(TRAINED_FOLDER)
            elif not lacks:
                unpack(fetch(task.trained), folder)
    except UserError as error:  # another node may have more room
        return Report(node, host, unfit=f"{error} (on {host})"), None
    if lacks:
        return Report(node, host, lacks=tuple(lacks)), None
    try:
        moved = {Path(each.path): place for name, each in task.inputs.items() if (place := places[name]) is not None}
        moved = {there: here for there, here in {**moved, Path(task.folder): folder}.items() if there != here}
        relocate(folder, moved)
        request = {**task.request, **{name: str(place) for name, place in places.items()}}
        outcome = run_in_folder(folder, request, _worker(task.environment), task.until)
        if outcome.killed:
            return Report(node, host, outcome, shared=shared), None
        relocate(folder, {here: there for there, here in moved.items()})
    except UserError as error:
        return Report(node, host, Outcome(Path(task.folder), None, f"{error} (on {host})"), shared=shared), None
    if shared:
        return Report(node, host, outcome), None
    if outcome.failed and free_disk_mb(own) < LEAST_FREE_MB:
        shutil.rmtree(folder, ignore_errors=True)
        return Report(node, host, unfit=f"{outcome.failed} (on {host})"), None
    parcel = pack(folder, _OF_FAILURES if outcome.failed and not (folder / "trained.json").exists() else ())
    shutil.rmtree(folder, ignore_errors=True)
    failed = outcome.failed and outcome.failed.replace(str(folder), task.folder)  # future path of its log
    return Report(node, host, replace(outcome, failed=failed), shared=False), parcel


def forget(node: str, digests: Mapping[str, Any]) -> None:
    """Remove inputs with these digests that this node received."""
    for digest in digests:
        shutil.rmtree(_own_folder(node) / "inputs" / digest, ignore_errors=True)


def _own_folder(node: str) -> Path:
    """Return the folder of this user and node on its disk (TMPDIR); raises ``UserError`` if it is another user's."""
    user = str(os.getuid()) if hasattr(os, "getuid") else ""
    folder = Path(tempfile.gettempdir()) / f"beags-{user}-{node[:16]}"
    with writing(folder):
        folder.mkdir(mode=0o700, exist_ok=True)
    if folder.is_symlink() or (user and str(folder.stat().st_uid) != user):
        raise UserError(f"{folder} is another user's: remove it, or name a place for temporary files with TMPDIR.")
    return folder


def _reads(path: str, content: str) -> bool:
    try:
        return Path(path).read_text() == content
    except OSError:
        return False


def _place(wanted: Input, copies: Path, fetch: Callable[[Any], bytes]) -> Path | None:
    """Return this node's path of an input, the folder itself or a received copy; None if it has to be sent."""
    path = Path(wanted.path)
    if path.is_dir() and folder_digest(path) == wanted.digest:
        return path
    copy = copies / wanted.digest
    with writing(copy):
        copies.mkdir(exist_ok=True)
    with FileLock(copies / f".{wanted.digest}.lock"):  # another task of this node may be unpacking it
        if not copy.exists():
            if wanted.parcel is None:
                return None
            unpack(fetch(wanted.parcel), copy)
    return copy


@lru_cache(None)
def _code() -> str:
    return code_of_trials()


_program: tuple[dict[str, str], Worker] | None = None


def _worker(environment: Mapping[str, str]) -> Worker:
    """Return the worker for these variables; it ends with this process, or when other variables need a new one."""
    global _program
    # Ray sets the visible devices of each task.
    variables = {**environment, "CUDA_VISIBLE_DEVICES": os.environ.get("CUDA_VISIBLE_DEVICES", "")}
    if _program is None or _program[0] != variables:
        if _program is not None:
            _program[1].end()
        _program = variables, Worker(environment)
    return _program[1]
