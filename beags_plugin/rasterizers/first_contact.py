"""Whether the CUDA backend may serve where nobody asked for it by name: it must first agree with the torch reference.

The first time that "auto" would take it on a machine, ``trial`` runs in a process of its own. What comes of it is kept
for this build on these GPUs with this driver. If it differs, crashes or takes too long, everything runs without it. A
GPU whose memory others have filled is tried again by the next command.
"""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

from beags_plugin.ops import cuda_extension, extension
from beags_plugin.system.child_processes import bound
from beags_plugin.system.digests import content_digest, value_digest
from beags_plugin.system.whole_files import write_text_atomically

TRUST = "BEAGS_TRUST_CUDA"
"""Environment variable: with "1", the CUDA backend is taken without a trial."""

_FULL = "out of memory"  # in what torch says of a GPU that others have filled
_RAISED = re.compile(r"[\w.]+(Error|Exception)\b")
_SECONDS = 180.0  # of a trial; most of it goes by while torch is imported and kernels are loaded
_BACKEND = "beags_plugin.rasterizers.cuda:CudaRasterizer"
_START = "import json, runpy, sys; sys.path[:] = json.loads(sys.argv.pop(1)); "
_CHILD = _START + "runpy.run_module('beags_plugin.rasterizers.trial', run_name='__main__', alter_sys=True)"


@dataclass(frozen=True)
class Verdict:
    """What came of a trial.

    reason: why the CPU serves, the end of a sentence; "" if the backend agrees. gpus: their names. seconds: it took.
    """

    reason: str
    gpus: str
    seconds: float


@dataclass(frozen=True)
class Contact:
    """A build of the CUDA backend and the GPUs before it.

    build: digest of the compiled module and its front. gpus: names of all devices. driver: its version. devices: for
    torch. backend: spec of the rasterizer.
    """

    build: str
    gpus: str
    driver: str
    devices: Sequence[str]
    backend: str = _BACKEND

    def file(self) -> Path:
        """Return where the verdict on this build, these GPUs and this driver is kept."""
        key = value_digest([self.build, self.gpus, self.driver])[:24]
        return cache_folder() / f"{key}.json"


def cache_folder() -> Path:
    """Return the folder of the verdicts: ``beags/cuda`` in XDG_CACHE_HOME, else in ~/.cache."""
    return Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "beags" / "cuda"


def this_machine() -> Contact | None:
    """Return the CUDA backend and the GPUs here; None where it cannot run at all (``cuda_extension.present``)."""
    module, _ = cuda_extension.present()
    if module is None:
        return None
    import torch

    count = torch.cuda.device_count()
    names = [torch.cuda.get_device_name(index) for index in range(count)]
    with_cuda = f"{torch.__version__}, CUDA {torch.version.cuda}"
    package = Path(__file__).parents[1]
    fronts = sorted([*(package / "ops").glob("*.py"), *(package / "rasterizers").glob("*.py")])
    build = value_digest([content_digest([Path(str(extension.module().__file__)), *fronts]), with_cuda])
    return Contact(build, ", ".join(names), _driver(module.driver_version()), [f"cuda:{each}" for each in range(count)])


def _driver(cuda_version: int) -> str:
    """Return the driver's version: Linux's module states it, elsewhere the newest CUDA that it knows stands for it."""
    with suppress(OSError):
        return Path("/proc/driver/nvidia/version").read_text("utf8").splitlines()[0]
    return str(cuda_version)


def verdict(contact: Contact, anew: bool = False, say: Callable[[str], None] | None = None) -> Verdict:
    """Return the kept verdict on a contact; where there is none, or ``anew``, try it (seconds to minutes) and keep it.

    say: receives a sentence before a trial.
    """
    path = contact.file()
    if not anew and (kept := _kept(path)) is not None:
        return kept
    if say is not None:
        say(f"First use of {contact.gpus} by this build: its kernels are compared with the torch reference, once.")
    began = time.monotonic()
    reason = try_in_child(contact.backend, contact.devices)
    found = Verdict(reason, contact.gpus, round(time.monotonic() - began, 1))
    if _FULL in reason:
        return found
    with suppress(OSError):  # a home that cannot be written to: the next command tries again
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text_atomically(json.dumps(asdict(found) | {"driver": contact.driver}, indent=2), path)
    return found


def _kept(path: Path) -> Verdict | None:
    try:
        held: dict[str, Any] = json.loads(path.read_text("utf8"))
        return Verdict(str(held["reason"]), str(held["gpus"]), float(held["seconds"]))
    except (OSError, ValueError, KeyError, TypeError):  # none, or a damaged one: it is made again
        return None


def try_in_child(backend: str, devices: Sequence[str], seconds: float = _SECONDS) -> str:
    """Run ``trial`` in a process of its own; return why the backend must not serve, or ""."""
    command = [sys.executable, "-c", _CHILD, json.dumps(sys.path), backend, *devices]
    environment = {**os.environ, TRUST: "1"}
    try:
        done = subprocess.run(
            bound(command, signal.SIGKILL), capture_output=True, text=True, timeout=seconds, env=environment
        )
    except subprocess.TimeoutExpired:
        return f"a small scene was not drawn within {seconds:g} seconds"
    if done.returncode < 0:
        with suppress(ValueError):
            return f"drawing a small scene ended with {signal.Signals(-done.returncode).name}"
    lines = done.stdout.strip().splitlines()
    if done.returncode != 0 or not lines:
        said = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
        raised = [line for line in said if _RAISED.match(line)]  # an exception's first line says what went wrong
        return f"drawing a small scene failed ({(raised or said)[-1]})"
    try:
        return str(json.loads(lines[-1]))
    except ValueError:
        return f"drawing a small scene ended without a result ({lines[-1]})"


@cache
def settle() -> str | None:
    """Return one sentence if the CUDA backend must not serve unasked, and take it out of this process's use; else None.

    None too where it cannot run at all, or is trusted (``TRUST``). The sentence is printed, once a process.
    """
    if os.environ.get(TRUST) == "1":
        return None
    try:
        if (contact := this_machine()) is None:
            return None
        found = verdict(contact, say=_say)
    except RuntimeError as error:
        found = Verdict(
            f"torch cannot open it ({(str(error).splitlines() or [type(error).__name__])[0]})", "the GPU", 0.0
        )
    if not found.reason:
        return None
    sentence = refusal(found)
    cuda_extension.refuse(sentence)
    _say(sentence)
    return sentence


def refusal(found: Verdict) -> str:
    """Return the sentence on a verdict that is against the GPU."""
    return (
        f"the CPU serves in place of {found.gpus}: {found.reason}; beags doctor tries again, {TRUST}=1 takes the GPU "
        "all the same."
    )


def _say(sentence: str) -> None:
    print(sentence[0].upper() + sentence[1:], file=sys.stderr, flush=True)
