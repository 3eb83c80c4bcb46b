"""The commands of ``beags bench``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Union

import tyro

from beags_benchmarks.experiments.captures.options import CapturesOptions
from beags_benchmarks.experiments.options import ExperimentOptions
from beags_benchmarks.experiments.paper.options import PaperOptions
from beags_benchmarks.samples.command import BenchSample


@dataclass
class ShippedExperiment(ExperimentOptions):
    """Run an experiment of files/."""

    experiment: tyro.conf.Suppress[str] = ""

    def run(self) -> None:
        from beags_benchmarks.experiments.run import run_experiment

        run_experiment(self.experiment, self)


@dataclass
class ExperimentFile(ExperimentOptions):
    """An experiment of your own, described by a TOML file like those of
    benchmarks/beags_benchmarks/experiments/files."""

    file: tyro.conf.Positional[Path] = Path("experiment.toml")
    """The TOML file."""

    def run(self) -> None:
        from beags_benchmarks.experiments.run import run_experiment

        run_experiment(str(self.file), self)


@dataclass
class PaperBench(PaperOptions):
    """The paper's tables: its methods on its data sets, as far as they are on disk. What is missing is listed."""

    def run(self) -> None:
        from beags_benchmarks.experiments.paper.run import run_paper

        run_paper(self)


@dataclass
class CapturesBench(CapturesOptions):
    """Real captures, as far as they are on disk: the paper's losses and each preset, scored by traced silhouettes."""

    def run(self) -> None:
        from beags_benchmarks.experiments.captures.run import run_captures

        run_captures(self)


@dataclass
class Nvos:
    """Take NVOS's masks of a scene of LLFF as its ground truth; its scribbles become prompts for masks."""

    data: Path
    """Folder of the scene, named as NVOS names it."""
    nvos: Path
    """NVOS's folder, of masks, scribbles and reference_image."""
    overwrite: bool = False
    """Replace masks and prompts that are there already."""

    def run(self) -> None:
        from beags_benchmarks.experiments.paper.nvos import import_nvos

        for line in import_nvos(self.data, self.nvos, self.overwrite):
            print(line)


SHIPPED = {
    "ablation": "What each part gives: assignment alone, without each of reprojection, boundary and occupancy loss, "
    "all.",
    "sensitivity": "How much the result depends on k (neighbours that set the voxel size) and Z (samples per "
    "Gaussian).",
    "masks": "How much damage to the masks costs, with and without reprojection.",
    "presets": "What the refinements of the presets cost and give, from one base.",
    "compare": "The paper's twelve other methods beside this one, from one base, on identical masks.",
    "compare-consistent": "The same with the consistent masks of this method for all.",
    "classes": "How time and memory of each method grow with the number of classes.",
}
"""Commands by experiment, with the sentence of their help."""

if TYPE_CHECKING:
    Measurement = ShippedExperiment | ExperimentFile | PaperBench | CapturesBench | BenchSample | Nvos
else:
    Measurement = Union[  # noqa: UP007  (of a tuple)
        tuple(
            Annotated[
                ShippedExperiment,
                tyro.conf.subcommand(name, default=ShippedExperiment(experiment=name), description=sentence),
            ]
            for name, sentence in SHIPPED.items()
        )
        + (
            Annotated[ExperimentFile, tyro.conf.subcommand("file")],
            Annotated[PaperBench, tyro.conf.subcommand("paper")],
            Annotated[CapturesBench, tyro.conf.subcommand("captures")],
            Annotated[BenchSample, tyro.conf.subcommand("sample")],
            Annotated[Nvos, tyro.conf.subcommand("nvos")],
        )
    ]


@dataclass
class Bench:
    """Measure, print tables, and write JSON, CSV and a picture."""

    what: Measurement

    def run(self) -> None:
        self.what.run()
