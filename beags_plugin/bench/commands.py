"""The commands of ``beags bench`` and their options."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Union

import tyro


@dataclass
class ExperimentOptions:
    """Run an experiment: many short trainings on common bases. An interrupted experiment continues."""

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

    def files(self, experiment: str) -> dict[str, Path]:
        """Return the files to write, by "json", "csv" and "picture"."""
        suffixes = {"json": ".json", "csv": ".csv", "picture": ".png"}
        return {kind: getattr(self, kind) or self.output / f"{experiment}{end}" for kind, end in suffixes.items()}


@dataclass
class ShippedExperiment(ExperimentOptions):
    """Run an experiment of experiments/."""

    experiment: tyro.conf.Suppress[str] = ""

    def run(self) -> None:
        from beags_plugin.bench.run import run_experiment

        run_experiment(self.experiment, self)


@dataclass
class ExperimentFile(ExperimentOptions):
    """An experiment of your own, described by a TOML file like those of experiments/."""

    file: tyro.conf.Positional[Path] = Path("experiment.toml")
    """The TOML file."""

    def run(self) -> None:
        from beags_plugin.bench.run import run_experiment

        run_experiment(str(self.file), self)


SHIPPED = {
    "ablation": "What each part gives: assignment alone, without each of reprojection, boundary and occupancy loss, "
    "all.",
    "sensitivity": "How much the result depends on k (neighbours that set the voxel size) and Z (samples per "
    "Gaussian).",
    "depth": "How much refinement needs of the base's depth: bases trained with and without depth and normal terms.",
    "masks": "How much damage to the masks costs, with and without reprojection.",
    "tradeoff": "What time and memory buy: every choice moved alone, and the Pareto front of cost and quality.",
    "presets": "What the refinements of the presets cost and give, from one base.",
    "improvements": "What each extension of the paper's refinement gives, beside the paper's own method.",
}
"""Commands by experiment, with the sentence of their help."""

if TYPE_CHECKING:
    Measurement = ShippedExperiment | ExperimentFile
else:
    Measurement = Union[  # noqa: UP007  (of a tuple)
        tuple(
            Annotated[
                ShippedExperiment,
                tyro.conf.subcommand(name, default=ShippedExperiment(experiment=name), description=sentence),
            ]
            for name, sentence in SHIPPED.items()
        )
        + (Annotated[ExperimentFile, tyro.conf.subcommand("file")],)
    ]
