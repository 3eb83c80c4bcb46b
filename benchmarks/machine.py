"""Where, of what and how a measurement was made: what every published figure has to name."""

from __future__ import annotations

import os
import shlex

from beags_plugin.bench.provenance import commit, describe_machine

__all__ = ["busy_note", "command", "commit", "describe_machine"]


def busy_note(cores: int) -> str | None:
    """A sentence if other programs were at work in the last minute; None if not, or where the system does not say."""
    try:
        load = os.getloadavg()[0]
    except (AttributeError, OSError):
        return None
    if load < 0.5 * cores:
        return None
    return (
        f"the machine was busy before the start (load {load:.1f} on {cores} cores): "
        "figures of several threads, which are wall time, mean little"
    )


def command(arguments: list[str]) -> str:
    """The command line, as typed after ``python``."""
    return shlex.join(["benchmarks/rasterizer.py", *arguments])
