"""The machine, command and commit of a measurement, which every published number must name."""

from __future__ import annotations

import os
import platform
import shlex
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import beags_plugin

_MEASURED = Path(beags_plugin.__file__).resolve()


def describe_machine() -> dict[str, str | int]:
    """Return the CPU's name, the cores that this process may use, the memory in MB and the system."""
    try:
        cores = len(os.sched_getaffinity(0))
    except AttributeError:  # macOS has no such call
        cores = os.cpu_count() or 1
    try:
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") >> 20
    except (ValueError, OSError):
        memory = 0
    return {"cpu": _cpu_name(), "cores": cores, "memory_mb": memory, "system": platform.system()}


def busy_note(cores: int) -> str | None:
    """Return a sentence if other programs were busy in the last minute, else None."""
    try:
        load = os.getloadavg()[0]
    except (AttributeError, OSError):
        return None
    if load < 0.5 * cores:
        return None
    return f"the machine was busy before the start (load {load:.1f} on {cores} cores): wall times mean little"


def _cpu_name() -> str:
    try:
        with open("/proc/cpuinfo") as lines:
            names = {key.strip(): value.strip() for key, _, value in (line.partition(":") for line in lines)}
        # ARM often has numbers only.
        family = " ".join(names[key] for key in ("cpu family", "model") if key in names)
        if "model name" in names:
            return f"{names['model name']} (family/model {family.replace(' ', '/')})" if family else names["model name"]
    except OSError:
        pass
    return platform.processor() or platform.machine()


def with_these_packages(environment: Mapping[str, str]) -> dict[str, str]:
    """Return the environment of a program that imports the same packages."""
    places = [str(Path(file).resolve().parents[1]) for file in (__file__, beags_plugin.__file__)]
    paths = os.pathsep.join(filter(None, [*places, environment.get("PYTHONPATH")]))
    return {**environment, "PYTHONPATH": paths}


def command() -> str:
    """Return the command line of this process, ``beags`` or ``python -m`` of another package's module."""
    spec = getattr(sys.modules["__main__"], "__spec__", None)
    program = ["beags"]
    if spec is not None and not spec.name.startswith("beags_plugin."):
        program = ["python", "-m", spec.name.removesuffix(".__main__")]
    return shlex.join([*program, *sys.argv[1:]])


def commit() -> str:
    """Return the measured commit, with "+" if files differ from it; "unknown" outside a clone of beags."""
    name = _git("rev-parse", "--short", "HEAD")
    if name is None or _git("ls-files", "--error-unmatch", str(_MEASURED)) is None:
        return "unknown"
    return name + ("+" if _git("status", "--porcelain", "--untracked-files=no") else "")


def _git(*arguments: str) -> str | None:
    try:
        done = subprocess.run(["git", *arguments], cwd=_MEASURED.parent, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return done.stdout.strip()
