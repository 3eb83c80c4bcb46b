"""Where, of what and how a measurement was made: what every published figure has to name."""

from __future__ import annotations

import shlex

from beags_plugin.bench.provenance import busy_note, commit, describe_machine

__all__ = ["busy_note", "command", "commit", "describe_machine"]


def command(arguments: list[str]) -> str:
    """The command line, as typed after ``python``."""
    return shlex.join(["benchmarks/rasterizer.py", *arguments])
