"""Options of ``beags bench captures``, which are its flags."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from beags_benchmarks.experiments.options import EngineOptions
from beags_plugin.system.output_option import OUTPUT


@dataclass
class CapturesOptions(EngineOptions):
    """Which captures to train on, and how."""

    data_root: Path
    """Folder that holds the captures' folders: bear, kitchen, garden, fruit, dtu_skull, figurine, fern."""
    truth: Path | None = None
    """Folder of traced silhouettes, <capture>/<object>/<photo>.png: 255 object, 0 other, 128 unknown."""
    scenes: tuple[str, ...] = ()
    """Which captures, by name; all if left out."""
    masks: tuple[str, ...] = ()
    """Which masks to train on: given, picked (cut from the base by committed clicks), salient; all if left out."""
    rows: Path | None = None
    """A TOML file of other rows, like files/captures/rows.toml."""
    variants: tuple[str, ...] = ()
    """Which rows, besides the reference; all if left out."""
    preset: str | None = None
    """Preset of method_configs/ for the base; that of the rows if left out."""
    size: int = 800
    """Most pixels of a photo's longer side; larger photos are scaled down."""
    quick: bool = False
    """Try it out: the first capture, photos of 130 pixels, few steps, figures that mean nothing."""
    output: Annotated[Path, OUTPUT] = Path("outputs/captures")
    """Folder of made masks, trials and results; a second call goes on where the first ended."""
    json: Path | None = None
    """File for all figures; <output>/captures.json if left out."""
    csv: Path | None = None
    """File for all figures as a table; <output>/captures.csv if left out."""
