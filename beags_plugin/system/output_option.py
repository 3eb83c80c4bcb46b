"""The option for the folder or file of results; every command takes both of its names."""

from __future__ import annotations

import tyro

OUTPUT = tyro.conf.arg(aliases=("--output-dir",))
OUTPUT_DIR = tyro.conf.arg(aliases=("--output",))
