"""The commands of ``beags bench``: what each measures and what can be asked of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

import tyro


@dataclass
class Trainings:
    """What all experiments share: many short trainings on common bases.

    What is done is not done again: an interrupted experiment goes on where it was.
    """

    EXPERIMENT: ClassVar[str] = ""

    data: tuple[Path, ...] = ()
    """Folders with images, poses and masks to train on, instead of the experiment's samples."""
    scenes: int | None = None
    """How many of the experiment's sample scenes; all if left out, none where --data is given."""
    preset: str | None = None
    """What to train with: a preset of method_configs/; the experiment's own if left out."""
    downscale: float | None = None
    """Divide the image size of --data by this; chosen for a quick run if left out."""
    quick: bool = False
    """Try the experiment out in a minute or two: tiny scenes, few steps, figures that mean nothing."""
    output: Path = Path("outputs/bench")
    """Folder of scenes, trials and results."""
    json: Path | None = None
    """File for all figures; <output>/<experiment>.json if left out."""
    csv: Path | None = None
    """File for all figures as a table; <output>/<experiment>.csv if left out."""
    picture: Path | None = None
    """File for the picture; <output>/<experiment>.png if left out."""

    def run(self) -> None:
        from beags_plugin.bench.run import Options, run_experiment

        options = {name: value for name, value in vars(self).items() if name != "file"}
        run_experiment(self.experiment(), Options(**options))

    def experiment(self) -> str:
        """Name of a shipped experiment (a file of experiments/), or the path of one."""
        return self.EXPERIMENT


@dataclass
class Ablation(Trainings):
    """What each part gives: assignment alone, without each of reprojection, boundary and occupancy loss, all."""

    EXPERIMENT: ClassVar[str] = "ablation"


@dataclass
class Sensitivity(Trainings):
    """How much the result depends on k (neighbours that set the voxel size) and Z (samples per Gaussian)."""

    EXPERIMENT: ClassVar[str] = "sensitivity"


@dataclass
class Depth(Trainings):
    """How much refinement needs of the base's depth: bases trained with and without depth and normal terms."""

    EXPERIMENT: ClassVar[str] = "depth"


@dataclass
class Masks(Trainings):
    """How much damage to the masks costs, with and without reprojection."""

    EXPERIMENT: ClassVar[str] = "masks"


@dataclass
class Tradeoff(Trainings):
    """What time and memory buy: every choice moved alone, and the Pareto front of cost and quality."""

    EXPERIMENT: ClassVar[str] = "tradeoff"


@dataclass
class Presets(Trainings):
    """What the refinements of the presets cost and give, from one base."""

    EXPERIMENT: ClassVar[str] = "presets"


@dataclass
class Improvements(Trainings):
    """What each extension of the paper's refinement gives, beside the paper's own method."""

    EXPERIMENT: ClassVar[str] = "improvements"


@dataclass
class ExperimentFile(Trainings):
    """An experiment of your own, described by a TOML file like those of experiments/."""

    file: tyro.conf.Positional[Path] = Path("experiment.toml")
    """The TOML file."""

    def experiment(self) -> str:
        return str(self.file)


Measurement = (
    Annotated[Ablation, tyro.conf.subcommand(name="ablation")]
    | Annotated[Sensitivity, tyro.conf.subcommand(name="sensitivity")]
    | Annotated[Depth, tyro.conf.subcommand(name="depth")]
    | Annotated[Masks, tyro.conf.subcommand(name="masks")]
    | Annotated[Tradeoff, tyro.conf.subcommand(name="tradeoff")]
    | Annotated[Presets, tyro.conf.subcommand(name="presets")]
    | Annotated[Improvements, tyro.conf.subcommand(name="improvements")]
    | Annotated[ExperimentFile, tyro.conf.subcommand(name="file")]
)
