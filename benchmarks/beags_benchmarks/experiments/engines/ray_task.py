"""What a node of a Ray cluster does for a trial: it trains it, or scores what was trained.

It works in the trial's folder where it sees that of the command (shared storage), else in a folder of its own, and
then it returns what it made. Photos, masks and bases that it does not see are sent to it once. Configs of runs name the
places of the command wherever they are not in use.
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
"""Entries of a trial's request that are folders which the trial reads."""
TRAINED_FOLDER = "trained folder"
"""What a node lacks, besides inputs, that scores what another one trained."""
_OF_FAILURES = ("failed.json", "log.txt", "trial.json")


@dataclass(frozen=True)
class Input:
    """A folder that a trial reads. path: where the command sees it. digest: ``folder_digest`` there.

    parcel: a reference to its bytes, or None as long as no node lacked it.
    """

    path: str
    digest: str
    parcel: Any = None


@dataclass(frozen=True)
class Task:
    """One step of a trial, for one node.

    folder: of the trial, as the command sees it. mark: a file beside it, and what it holds: a node that reads the same
    shares the folder. request: ``Job.request``. until: ``TRAINED`` or ``SCORED``. code: digest of the command's code.
    environment: variables of the trial. inputs: by name in the request. trained: reference to the bytes of the folder
    once it was trained, if another node did that on its own disk.
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
    """How a task ended.

    node, host: who did it. outcome: None where it was not done: ``lacks`` names what to send, or ``unfit`` says in a
    sentence why this node can do none. shared: whether the files are in the trial's folder.
    """

    node: str
    host: str
    outcome: Outcome | None = None
    lacks: tuple[str, ...] = ()
    unfit: str | None = None
    shared: bool = True


def perform(task: Task, node: str, fetch: Callable[[Any], bytes]) -> tuple[Report, bytes | None]:
    """Do the task; returns how it ended and, where the trial's folder is not shared, its bytes.

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
    failed = outcome.failed and outcome.failed.replace(str(folder), task.folder)  # where its log will lie
    return Report(node, host, replace(outcome, failed=failed), shared=False), parcel


def forget(node: str, digests: Mapping[str, Any]) -> None:
    """Remove the inputs of these digests that this node was sent."""
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


def _place(wanted: Input, kept: Path, fetch: Callable[[Any], bytes]) -> Path | None:
    """Return where this node has an input: the very folder, or what it was sent; None if it has to be sent."""
    path = Path(wanted.path)
    if path.is_dir() and folder_digest(path) == wanted.digest:
        return path
    copy = kept / wanted.digest
    with writing(copy):
        kept.mkdir(exist_ok=True)
    with FileLock(kept / f".{wanted.digest}.lock"):  # another task of this node may unpack it
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
    """Return the program that runs trials with these variables; it ends with this process, or for one with others."""
    global _program
    wanted = {**environment, "CUDA_VISIBLE_DEVICES": os.environ.get("CUDA_VISIBLE_DEVICES", "")}  # by Ray, for the task
    if _program is None or _program[0] != wanted:
        if _program is not None:
            _program[1].end()
        _program = wanted, Worker(environment)
    return _program[1]
