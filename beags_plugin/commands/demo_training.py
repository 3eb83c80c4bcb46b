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

from beags_plugin.commands.answers import CONSOLE, read_object
from beags_plugin.commands.scene_setup import MadeScene
from beags_plugin.system.child_processes import bound
from beags_plugin.system.errors import UserError
from beags_plugin.system.lock import run_lock
from beags_plugin.system.memory import trim_memory
from beags_plugin.system.pasted import command, quoted
from beags_plugin.system.whole_files import write_text_atomically

STAMP = "trained.json"  # This file beside the run holds the request that it was trained for.
WITHOUT = "without"  # This key of it holds the photos that are left out for their wrong poses.
FEW, MOST_LEFT_OUT = 2, 0.3  # Least number of photos that are worth another training, and largest share.
STARTED = "started"  # This key of it holds the request until the training ends.
AGREE = ("--pipeline.model.prepare.agree", "True")  # A network's masks have the same errors in many views.
QUIET = ("--logging.steps-per-log", "200", "--logging.local-writer.max-log-size", "0")  # Used if output is no terminal.


def train_once(
    scene: MadeScene, output: Path, request: dict[str, Any], fresh: bool, replace: bool = False,
    words: Sequence[str] = (),
) -> None:  # fmt: skip
    """Train what is requested unless that was done before; resume it if it was interrupted.

    replace: whether a complete run may be replaced, because it was a step on the way to this one. words: further
    options of the training. Raises ``UserError`` if another complete run would be replaced.
    """
    run = output / "run"
    if not fresh and trained(output, request):
        CONSOLE.print(f"Trained before: {run} (add --fresh to train again).")
        return
    if run.exists() and not (output / STAMP).exists():
        raise UserError(f"{run} is not the demo's: choose another --output, or move it away.")
    if run.is_dir():
        run_lock(run).release()  # It raises if the same demo is being trained.
    if not fresh and read_stamp(output).get(STARTED) == request and (run / "config.yml").exists():
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
    """Write the request of the run in ``output``; under ``STARTED`` as long as it is being trained."""
    write_text_atomically(json.dumps(content), output / STAMP)


def read_stamp(output: Path) -> dict[str, Any]:
    """Return what ``write_stamp`` wrote; empty if that cannot be read."""
    return read_object(output / STAMP)


def trained(output: Path, request: dict[str, Any]) -> bool:
    """Return whether the same request was trained to its end."""
    former = read_stamp(output)
    return request in (former, former.get(STARTED)) and (output / "run" / "training.json").exists()


def without_photos(output: Path, request: dict[str, Any]) -> tuple[str, ...]:
    """Return the photos that an earlier training of the same request left out; none if it left out none."""
    former = read_stamp(output)
    former = dict(former.get(STARTED, former))
    names = former.pop(WITHOUT, ())
    return tuple(names) if former == request else ()


def misplaced(run: Path) -> tuple[str, ...]:
    """Return photos with wrong poses, by the agreement of the masks, if they are few but worth another training."""
    agreement = read_object(run / "prepared/report.json").get("agreement") or {}
    names = agreement.get("misplaced", [])
    few = FEW <= len(names) <= MOST_LEFT_OUT * len(agreement.get("views", []))
    return tuple(names) if few and not any("/" in name for name in names) else ()


def difference(stamp: dict[str, Any], request: dict[str, Any]) -> str:
    """Describe how the earlier request in a stamp differs from ``request``."""
    former = stamp.get(STARTED, stamp)
    if bool(former.get("pick")) != bool(request.get("pick")):
        return "with --pick" if former.get("pick") else "without --pick"
    if former.get("objects") != request.get("objects"):
        return " ".join(("with --objects", str(former["objects"]))) if "objects" in former else "without --objects"
    for name, flag in (("preset", "--preset"), ("downscale", "--downscale")):
        if former.get(name) != request.get(name):
            return f"with {flag} {former.get(name)}"
    return "from other data or by another version"


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
    """Return the environment of a child process in which other libraries print no warnings of future changes."""
    return {**os.environ, "PYTHONWARNINGS": os.environ.get("PYTHONWARNINGS", "ignore::FutureWarning")}


def finish(words: list[str]) -> None:
    """Run a training; raises ``UserError`` where it fails."""
    trim_memory()  # This process waits meanwhile.
    code = subprocess.run(bound(words), env=quiet_environment()).returncode
    if code != 0:
        raise UserError(f"training ended with exit code {code}; what it printed above says why.")
