"""Options of every experiment, which are flags of its command."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from beags_plugin.system.output_option import OUTPUT


@dataclass(kw_only=True)
class EngineOptions:
    """The engine for trials."""

    plan: bool = False
    """Only print the trials and the hours, memory and disk that they need."""
    engine: str = "local"
    """Engine for the trials: local (this machine, one after the other) or ray (a Ray cluster; docs/experiments.md)."""
    address: str | None = None
    """Address of the Ray cluster: auto (the one that this machine is part of), or host:port; if left out, Ray is
    started on this machine alone."""


@dataclass
class ExperimentOptions(EngineOptions):
    """Run an experiment: many short trainings on common bases. An interrupted experiment continues."""

    data: tuple[Path, ...] = ()
    """Folders with images, poses and masks to train on, instead of the experiment's samples."""
    scenes: int | None = None
    """Number of the experiment's sample scenes; all if left out, none with --data."""
    preset: str | None = None
    """Preset of method_configs/; the experiment's own if left out."""
    downscale: float | None = None
    """Divide the image size of --data by this; chosen for a quick run if left out."""
    variants: Annotated[tuple[str, ...], tyro.conf.arg(aliases=["--methods"])] = ()
    """Which of the experiment's variants to run, besides its reference; all with "all" or if left out."""
    quick: bool = False
    """Try the experiment out in a minute or two: tiny scenes, few steps, figures that mean nothing."""
    output: Annotated[Path, OUTPUT] = Path("outputs/bench")
    """Folder of scenes, trials and results."""
    json: Path | None = None
    """File for all figures; <output>/<experiment>.json if left out."""
    csv: Path | None = None
    """File for all figures as a table; <output>/<experiment>.csv if left out."""
    picture: Path | None = None
    """File for the picture; <output>/<experiment>.png if left out."""

    def files(self, experiment: str) -> dict[str, Path]:
        """Return the files to write, by "json", "csv" and "picture"."""
        suffixes = {"json": ".json", "csv": ".csv", "picture": ".png"}
        return {kind: getattr(self, kind) or self.output / f"{experiment}{end}" for kind, end in suffixes.items()}
