"""Options of ``beags bench paper``, which are its flags."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from beags_benchmarks.experiments.options import EngineOptions
from beags_plugin.system.output_option import OUTPUT


@dataclass
class PaperOptions(EngineOptions):
    """Which of the paper's methods to run on which of its data sets, and how."""

    data_root: Path
    """Folder that holds the data sets' folders: mip360, llff, lerf, 3dovs (benchmarks/README.md)."""
    data_set: tuple[str, ...] = ()
    """Which data sets: mip360, llff, lerf, 3dovs; all if left out."""
    methods: tuple[str, ...] = ()
    """Which methods of files/paper/methods.toml; all if left out."""
    scenes: tuple[str, ...] = ()
    """Which scenes, by name; all if left out."""
    preset: str | None = None
    """Preset of method_configs/ instead of beags-paper; figures are then not the paper's."""
    downscale: float = 1.0
    """Divide the paper's image sizes by this; figures are then not the paper's."""
    quick: bool = False
    """Try it out: small photos, few steps, figures that mean nothing."""
    output: Annotated[Path, OUTPUT] = Path("outputs/paper")
    """Folder of trials and results; a second call goes on where the first ended."""
    json: Path | None = None
    """File for all figures; <output>/paper.json if left out."""
    csv: Path | None = None
    """File for all figures as a table; <output>/paper.csv if left out."""
