"""Decide whether "auto" may choose the CUDA backend: it must first agree with the torch reference.

The first time that "auto" would choose it on a machine, ``trial`` runs in a process of its own. Its verdict is saved
for this build, these GPUs and this driver. If results differ, or the trial crashes or takes too long, "auto" does not
use the backend. A GPU whose memory is full is tried again by the next command.
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
"""Environment variable: with "1", the CUDA backend is used without a trial."""

_FULL = "out of memory"  # words of torch's error for a GPU whose memory is full
_RAISED = re.compile(r"[\w.]+(Error|Exception)\b")
_SECONDS = 180.0  # limit of a trial, most of which goes into importing torch and loading kernels
_BACKEND = "beags_plugin.rasterizers.cuda:CudaRasterizer"
_START = "import json, runpy, sys; sys.path[:] = json.loads(sys.argv.pop(1)); "
_CHILD = _START + "runpy.run_module('beags_plugin.rasterizers.trial', run_name='__main__', alter_sys=True)"


@dataclass(frozen=True)
class Verdict:
    """The result of a trial.

    reason: why the backend must not be used, the end of a sentence; "" if it agrees. gpus: their names. seconds: the
    trial's time.
    """

    reason: str
    gpus: str
    seconds: float


@dataclass(frozen=True)
class Contact:
    """A build of the CUDA backend and the GPUs that it meets.

    build: digest of the compiled module and its front. gpus: names of all devices. driver: its version. devices:
    torch's names of them. backend: spec of the rasterizer.
    """

    build: str
    gpus: str
    driver: str
    devices: Sequence[str]
    backend: str = _BACKEND

    def file(self) -> Path:
        """Return the file of the verdict, in ``beags/cuda`` of XDG_CACHE_HOME, else of ~/.cache."""
        key = value_digest([self.build, self.gpus, self.driver])[:24]
        cache = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser()
        return cache / "beags" / "cuda" / f"{key}.json"


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
    """Return the driver's version by Linux's kernel module, elsewhere the newest CUDA that it supports."""
    with suppress(OSError):
        return Path("/proc/driver/nvidia/version").read_text("utf8").splitlines()[0]
    return str(cuda_version)


def verdict(contact: Contact, anew: bool = False, say: Callable[[str], None] | None = None) -> Verdict:
    """Return the saved verdict on a contact; without one, or ``anew``, run the trial (seconds to minutes) and save it.

    say: receives a sentence before a trial.
    """
    path = contact.file()
    if not anew and (saved := _saved(path)) is not None:
        return saved
    if say is not None:
        say(f"First use of {contact.gpus} by this build: its kernels are compared with the torch reference, once.")
    began = time.monotonic()
    reason = try_in_child(contact.backend, contact.devices)
    result = Verdict(reason, contact.gpus, round(time.monotonic() - began, 1))
    if _FULL in reason:
        return result
    with suppress(OSError):  # If the folder cannot be written, the next command tries again.
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text_atomically(json.dumps(asdict(result) | {"driver": contact.driver}, indent=2), path)
    return result


def _saved(path: Path) -> Verdict | None:
    try:
        content: dict[str, Any] = json.loads(path.read_text("utf8"))
        return Verdict(str(content["reason"]), str(content["gpus"]), float(content["seconds"]))
    except (OSError, ValueError, KeyError, TypeError):  # A missing or damaged file is written again.
        return None


def try_in_child(backend: str, devices: Sequence[str], seconds: float = _SECONDS) -> str:
    """Run ``trial`` in a process of its own; return why the backend must not be used, or ""."""
    command = [sys.executable, "-c", _CHILD, json.dumps(sys.path), backend, *devices]
    environment = {**os.environ, TRUST: "1"}
    try:
        done = subprocess.run(
            bound(command, signal.SIGKILL), capture_output=True, text=True, timeout=seconds, env=environment
        )
    except subprocess.TimeoutExpired:
        return f"a small scene was not rendered within {seconds:g} seconds"
    if done.returncode < 0:
        with suppress(ValueError):
            return f"rendering a small scene ended with {signal.Signals(-done.returncode).name}"
    lines = done.stdout.strip().splitlines()
    if done.returncode != 0 or not lines:
        errors = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
        raised = [line for line in errors if _RAISED.match(line)]  # An exception's first line names the cause.
        return f"rendering a small scene failed ({(raised or errors)[-1]})"
    try:
        return str(json.loads(lines[-1]))
    except ValueError:
        return f"rendering a small scene ended without a result ({lines[-1]})"


@cache
def settle() -> str | None:
    """Refuse the CUDA backend in this process if "auto" must not choose it, and return one sentence why; else None.

    Returns None too where it cannot run at all, or is trusted (``TRUST``). The sentence is printed once per process.
    """
    if os.environ.get(TRUST) == "1":
        return None
    try:
        if (contact := this_machine()) is None:
            return None
        result = verdict(contact, say=_say)
    except RuntimeError as error:
        cause = (str(error).splitlines() or [type(error).__name__])[0]
        result = Verdict(f"torch cannot open it ({cause})", "the GPU", 0.0)
    if not result.reason:
        return None
    sentence = refusal(result)
    cuda_extension.refuse(sentence)
    _say(sentence)
    return sentence


def refusal(against: Verdict) -> str:
    """Return the sentence on a verdict against the GPU."""
    return (
        f"the CPU is used instead of {against.gpus}: {against.reason}; beags doctor tries again, {TRUST}=1 uses the "
        "GPU all the same."
    )


def _say(sentence: str) -> None:
    print(sentence[0].upper() + sentence[1:], file=sys.stderr, flush=True)
