"""The source of a measurement, which every published figure has to name."""

from __future__ import annotations

import shlex

from beags_plugin.bench.provenance import busy_note, commit, describe_machine

__all__ = ["busy_note", "command", "commit", "describe_machine"]


def command(arguments: list[str]) -> str:
    """Return the command line, as typed after ``python``."""
    return shlex.join(["benchmarks/rasterizer.py", *arguments])
