"""Trainings of ``beags demo``: each once, resumed where it was interrupted, and never over a run that was finished."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from beags_plugin.commands.scene_setup import MadeScene
from beags_plugin.system.child_processes import bound
from beags_plugin.system.errors import UserError
from beags_plugin.system.lock import run_lock
from beags_plugin.system.pasted import command, quoted
from beags_plugin.system.whole_files import write_text_atomically

CONSOLE = Console(soft_wrap=True, highlight=False, markup=False)  # paths may hold brackets
STAMP = "trained.json"  # beside the run: the request that it was made from
STARTED = "started"  # the key that holds the request until the training ends
AGREE = ("--pipeline.model.prepare.agree", "True")  # a network's masks err in many views alike
QUIET = ("--logging.steps-per-log", "50", "--logging.local-writer.max-log-size", "0")  # where no table can be redrawn


def train_once(
    scene: MadeScene, output: Path, request: dict[str, Any], fresh: bool, replace: bool = False,
    words: Sequence[str] = (),
) -> None:  # fmt: skip
    """Train what is requested, unless that was done before, or resume it.

    replace: the run that lies there is a step on the way to this one. words: further options of the training. Raises
    ``UserError`` where another run, trained to its end, would be replaced.
    """
    run = output / "run"
    if not fresh and trained(output, request):
        CONSOLE.print(f"Trained before: {run} (add --fresh to train again).")
        return
    if run.exists() and not (output / STAMP).exists():
        raise UserError(f"{run} is not the demo's: choose another --output, or move it away.")
    if run.is_dir():
        run_lock(run).release()  # refuses if the same demo is being trained
    if not fresh and _interrupted(output, request):
        resume(run)
    else:
        if (run / "training.json").exists() and not (fresh or replace):
            raise UserError(
                f"{run} holds a run that was trained {difference(read_stamp(output), request)}: add --fresh to "
                "replace it, or choose another --output."
            )
        shutil.rmtree(run, ignore_errors=True)
        write_stamp(output, {STARTED: request})
        train(scene, run, request["preset"], request["downscale"], request.get("photos", "all"), words)
    write_stamp(output, request)


def write_stamp(output: Path, content: dict[str, Any]) -> None:
    """Write the request that the run in ``output`` was made from, or, under ``STARTED``, is being made from."""
    write_text_atomically(json.dumps(content), output / STAMP)


def read_stamp(output: Path) -> dict[str, Any]:
    """Return what ``write_stamp`` wrote; empty where there is nothing that can be read."""
    try:
        former = json.loads((output / STAMP).read_text())
    except (OSError, ValueError):
        return {}
    return former if isinstance(former, dict) else {}


def trained(output: Path, request: dict[str, Any]) -> bool:
    """Return whether the same request was trained before, to its end."""
    former = read_stamp(output)
    return request in (former, former.get(STARTED)) and (output / "run" / "training.json").exists()


def difference(stamp: dict[str, Any], request: dict[str, Any]) -> str:
    """Return in which way an earlier request, as its stamp holds it, differs from ``request``."""
    former = stamp.get(STARTED, stamp)
    if bool(former.get("pick")) != bool(request.get("pick")):
        return "with --pick" if former.get("pick") else "without --pick"
    if former.get("objects") != request.get("objects"):
        return " ".join(("with --objects", str(former["objects"]))) if "objects" in former else "without --objects"
    for name, flag in (("preset", "--preset"), ("downscale", "--downscale")):
        if former.get(name) != request.get(name):
            return f"with {flag} {former.get(name)}"
    return "from other data or by another version"


def _interrupted(output: Path, request: dict[str, Any]) -> bool:
    """Return whether a training of the same request was interrupted and can resume."""
    return read_stamp(output).get(STARTED) == request and (output / "run" / "config.yml").exists()


def train(scene: MadeScene, run: Path, preset: str, downscale: float, photos: str, words: Sequence[str] = ()) -> None:
    """Run ns-train in a process of its own, as a user would; words: further options."""
    program = [
        str(Path(sys.executable).parent / "ns-train"), preset, "--data", str(scene.data),
        "--run-dir", str(run.absolute()), "--vis", "tensorboard", "--pipeline.datamanager.photos", photos,
        *(AGREE if scene.made_masks is not None and photos == "all" and not words else ()),
        *(() if sys.stdout.isatty() else QUIET), *words,
        "beags-data", "--downscale-factor", str(downscale), *scene.options(),
    ]  # fmt: skip
    CONSOLE.print(f"$ {command(program)}")
    finish(program)


def resume(run: Path) -> None:
    """Resume an interrupted training in a process of its own."""
    CONSOLE.print(
        f"Resuming the training that was interrupted (add --fresh to start anew).\n$ beags resume {quoted(run)}"
    )
    finish([sys.executable, "-m", "beags_plugin.commands.cli", "resume", str(run)])


def quiet_environment() -> dict[str, str]:
    """Return the environment of a child process, in which other libraries do not warn of what they will change."""
    return {**os.environ, "PYTHONWARNINGS": os.environ.get("PYTHONWARNINGS", "ignore::FutureWarning")}


def finish(words: list[str]) -> None:
    """Run a training; raises ``UserError`` where it fails."""
    code = subprocess.run(bound(words), env=quiet_environment()).returncode
    if code != 0:
        raise UserError(f"training ended with exit code {code}; what it printed above says why.")
