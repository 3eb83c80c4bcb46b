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
class Base(Trainings):
    """How well bases of different lengths draw held-out views, against steps and number of Gaussians."""

    EXPERIMENT: ClassVar[str] = "base"

    def run(self) -> None:
        from beags_plugin.bench.base_training import run_base
        from beags_plugin.bench.run import Options

        run_base(self.experiment(), Options(**vars(self)))


@dataclass
class BaseLimits(Base):
    """What limits held-out quality of a short base: the same with one part of the schedule changed."""

    EXPERIMENT: ClassVar[str] = "base-limits"


@dataclass
class ExperimentFile(Trainings):
    """An experiment of your own, described by a TOML file like those of experiments/."""

    file: tyro.conf.Positional[Path] = Path("experiment.toml")
    """The TOML file."""

    def experiment(self) -> str:
        return str(self.file)


@dataclass
class Reprojection:
    """Time and accuracy of the mask reprojections against the number of views, on the sample."""

    views: tuple[int, ...] = (30, 60, 120, 240)
    """Numbers of training views; a base is trained for each."""
    depths: tuple[str, ...] = ("trained", "exact")
    """What is lifted: the trained base's depth, the sample's exact depth."""
    methods: tuple[str, ...] = ("pairwise", "voxel")
    """Names of reprojections; the others are compared with pairwise."""
    preset: str = "beags-tiny"
    """Preset whose base phase is trained."""
    seed: int = 0
    """Seed of the sample."""
    width: int = 256
    """Pixels."""
    height: int = 192
    """Pixels."""
    calls: int = 3
    """How often each is timed; the least time counts."""
    output: Path = Path("outputs/bench")
    """Folder of scenes, bases and results."""
    json: Path | None = None
    """File for all figures; <output>/reprojection.json if left out."""
    csv: Path | None = None
    """File for all figures as a table; <output>/reprojection.csv if left out."""
    picture: Path | None = None
    """File for the picture; <output>/reprojection.png if left out."""

    def run(self) -> None:
        from beags_plugin.bench.reprojection import Options, run_reprojection

        run_reprojection(Options(**vars(self)))


@dataclass
class Scaling:
    """Time and memory of a refinement step and of each stage before it against classes, views, Gaussians and pixels."""

    classes: tuple[int, ...] = (1, 4, 16, 64, 256)
    """Numbers of object classes."""
    views: tuple[int, ...] = (4, 8, 16, 32)
    """Numbers of training views."""
    gaussians: tuple[int, ...] = (2_500, 5_000, 10_000, 20_000)
    """Numbers of Gaussians."""
    pixels: tuple[int, ...] = (4_800, 10_800, 19_200, 43_200)
    """Pixels of a view."""
    channels: int = 16
    """Up to so many classes, the step of methods that draw a channel per class is measured beside ours."""
    calls: int = 3
    """How often each is timed, in turn; the median counts."""
    quick: bool = False
    """Try it out in seconds: tiny sizes, figures that mean nothing."""
    output: Path = Path("outputs/bench")
    """Folder of results."""
    json: Path | None = None
    """File for all figures; <output>/scaling.json if left out."""
    csv: Path | None = None
    """File for all figures as a table; <output>/scaling.csv if left out."""
    picture: Path | None = None
    """File for the picture; <output>/scaling.png if left out."""

    def run(self) -> None:
        from beags_plugin.bench.scaling import Options, run_scaling

        run_scaling(Options(**vars(self)))


Measurement = (
    Annotated[Ablation, tyro.conf.subcommand(name="ablation")]
    | Annotated[Sensitivity, tyro.conf.subcommand(name="sensitivity")]
    | Annotated[Depth, tyro.conf.subcommand(name="depth")]
    | Annotated[Masks, tyro.conf.subcommand(name="masks")]
    | Annotated[Tradeoff, tyro.conf.subcommand(name="tradeoff")]
    | Annotated[Presets, tyro.conf.subcommand(name="presets")]
    | Annotated[Improvements, tyro.conf.subcommand(name="improvements")]
    | Annotated[Base, tyro.conf.subcommand(name="base")]
    | Annotated[BaseLimits, tyro.conf.subcommand(name="base-limits")]
    | Annotated[Reprojection, tyro.conf.subcommand(name="reprojection")]
    | Annotated[Scaling, tyro.conf.subcommand(name="scaling")]
    | Annotated[ExperimentFile, tyro.conf.subcommand(name="file")]
)
