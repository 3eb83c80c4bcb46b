"""python -m benchmarks.base_training: quality of held-out views over steps and number of Gaussians."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from rich.console import Console

from beags_plugin.bench.engines import make_engine
from beags_plugin.bench.engines.interface import Outcome
from beags_plugin.bench.experiment import Experiment, Variant, load_experiment
from beags_plugin.bench.options import ExperimentOptions
from beags_plugin.bench.report import (
    new_figure,
    number,
    plain_table,
    provenance,
    save_figure,
    write_csv,
    write_json,
)
from beags_plugin.bench.run import TABLE_WIDTH, adapted, scenes_of
from beags_plugin.bench.runner import run_trials
from beags_plugin.bench.scenes import TrialScene
from beags_plugin.bench.trials import MODEL, Trial, steps_of
from beags_plugin.plugin.training.monitor import CURVE
from beags_plugin.system.digests import code_digest
from beags_plugin.system.errors import UserError, print_user_errors_plainly
from beags_plugin.system.progress import progress_bar

CONSOLE = Console(soft_wrap=True, highlight=False, markup=False)  # paths may hold brackets
MEASUREMENTS = 20  # of the held-out views during a run
Curve = Sequence[Mapping[str, float]]


@dataclass(frozen=True)
class CurveRow:
    """A variant's base on a scene.

    curve: records of ``plugin.training.monitor``; empty with the reason in ``failed``.
    """

    scene: str
    seed: int
    variant: str
    curve: Curve
    peak_memory_mb: float | None = None
    failed: str | None = None

    def figures(self, best: float | None) -> dict[str, Any]:
        """Return one line of the table. best: PSNR of the reference variant on this scene, dB."""
        last = self.curve[-1] if self.curve else {}
        psnr = last.get("psnr")
        return {
            "scene": self.scene,
            "seed": self.seed,
            "variant": self.variant,
            "steps": last.get("step"),
            "gaussians": last.get("gaussians"),
            "psnr": psnr,
            "ssim": last.get("ssim"),
            "train_psnr": last.get("train_psnr"),
            "behind": None if psnr is None or best is None else best - psnr,
            "minutes": _minutes(last.get("seconds")),
            "cpu_minutes": _minutes(last.get("cpu_seconds")),
            "peak_memory_mb": self.peak_memory_mb,
            "failed": self.failed,
        }


def run_base(name: str, options: ExperimentOptions) -> list[CurveRow]:
    """Run the trials that are not done, print a table and write its files; returns the rows.

    name: of an experiment; its overrides of the refinement do not count. Raises ``UserError`` for a mistake in it
    or in the options.
    """
    experiment = adapted(load_experiment(name), options)
    source = {**provenance(), "quick": options.quick}  # before the trials: they keep the machine busy
    rows = train_rows(experiment, options)
    lines = report_lines(rows, experiment.reference)
    wide = Console(width=max(CONSOLE.width, TABLE_WIDTH), highlight=False, markup=False)
    wide.print(plain_table(f"{experiment.name}, {experiment.preset}", _COLUMNS, [cells(line) for line in lines]))
    files = options.files(experiment.name)
    write_json(files["json"], {**experiment.header(), **source, "rows": lines, "curves": curve_json(rows)})
    write_csv(files["csv"], lines)
    plot(files["picture"], rows)
    for kind, path in files.items():
        CONSOLE.print(f"{kind}: {path}")
    return rows


def train_rows(experiment: Experiment, options: ExperimentOptions) -> list[CurveRow]:
    """Run the bases of an experiment that are not done; returns a row for each, scene after scene."""
    trials = plan(experiment, scenes_of(experiment, options), code_digest())
    if options.plan:
        raise UserError("--plan is of beags bench: leave it out here.")
    engine = make_engine(options.engine, options.address)
    with engine, progress_bar("Training, in steps") as progress:
        outcomes = run_trials([trial for _, trial in trials], options.output / "trials", steps_of, engine, progress)
    return [read_row(variant, trial, outcomes[trial.digest]) for variant, trial in trials]


def curve_json(rows: Sequence[CurveRow]) -> list[dict[str, Any]]:
    """Return the curves of all rows as a result file holds them."""
    return [{"scene": row.scene, "seed": row.seed, "variant": row.variant, "curve": row.curve} for row in rows]


def plan(experiment: Experiment, scenes: Sequence[TrialScene], code: str) -> list[tuple[Variant, Trial]]:
    """Return every variant's base on every scene with every seed, measured ``MEASUREMENTS`` times on the way."""
    trials = []
    for scene in scenes:
        for seed in experiment.seeds:
            for variant in experiment.variants:
                overrides = {**variant.base, MODEL + "refine_steps": 0}
                steps = steps_of(Trial(scene, experiment.preset, overrides, seed, code))
                overrides["steps_per_held_out"] = max(steps // MEASUREMENTS, 1)
                trials.append((variant, Trial(scene, experiment.preset, overrides, seed, code)))
    return trials


def read_row(variant: Variant, trial: Trial, outcome: Outcome) -> CurveRow:
    """Return the row of a trial's outcome."""
    place = (trial.scene.name, trial.seed, variant.name)
    if outcome.result is None:
        return CurveRow(*place, (), failed=outcome.failed)
    curve = json.loads((outcome.folder / "run" / CURVE).read_text())
    return CurveRow(*place, curve, outcome.result["peak_memory_mb"])


def report_lines(rows: Sequence[CurveRow], reference: str | None) -> list[dict[str, Any]]:
    """Return ``CurveRow.figures`` of every row, compared with the reference variant of its scene and seed."""
    best = {(row.scene, row.seed): row.curve[-1]["psnr"] for row in rows if row.variant == reference and row.curve}
    return [row.figures(best.get((row.scene, row.seed))) for row in rows]


_COLUMNS = (
    "scene", "variant", "steps", "Gaussians", "PSNR, dB", "SSIM", "behind, dB", "training PSNR", "minutes",
    "CPU minutes", "memory, MB",
)  # fmt: skip


def cells(line: Mapping[str, Any]) -> list[str]:
    """Return one line of the table as text."""
    figures = (("steps", 0), ("gaussians", 0), ("psnr", 2), ("ssim", 3), ("behind", 2), ("train_psnr", 2))
    costs = (("minutes", 1), ("cpu_minutes", 1), ("peak_memory_mb", 0))
    name = line["variant"] if line["failed"] is None else f"{line['variant']} failed: {line['failed']}"
    return [line["scene"], name, *(number(line[key], digits) for key, digits in (*figures, *costs))]


def plot(path: Path, rows: Sequence[CurveRow]) -> None:
    """Plot, for each scene, PSNR of held-out views (dotted: training views) and number of Gaussians over steps."""
    scenes = list(dict.fromkeys(row.scene for row in rows))
    variants = list(dict.fromkeys(row.variant for row in rows))
    figure, axes = new_figure(len(scenes), 2)
    for column, scene in enumerate(scenes):
        above, below = axes[0][column], axes[1][column]
        for row in rows:
            if row.scene != scene or not row.curve:
                continue
            color = f"C{variants.index(row.variant)}"
            steps = [record["step"] for record in row.curve]
            above.plot(steps, [record["psnr"] for record in row.curve], ".-", color=color, label=row.variant)
            above.plot(steps, [record["train_psnr"] for record in row.curve], ":", color=color)
            below.plot(steps, [record["gaussians"] for record in row.curve], ".-", color=color)
        above.set_title(f"{scene}: PSNR, dB (dotted: training views)", fontsize="medium")
        below.set_title("Gaussians", fontsize="medium")
        below.set_xlabel("steps")
        below.set_yscale("log")
        for axis in (above, below):
            axis.set_xscale("log")
    axes[0][0].legend(fontsize="small")
    save_figure(path, figure)


def _minutes(seconds: float | None) -> float | None:
    return None if seconds is None else seconds / 60


@dataclass
class Arguments(ExperimentOptions):
    """Measure how well bases render held-out views, over steps and number of Gaussians."""

    file: tyro.conf.Positional[str] = "benchmarks/base.toml"
    """A TOML file; by default bases of different lengths."""

    def run(self) -> None:
        """Train and report."""
        run_base(self.file, self)


if __name__ == "__main__":
    print_user_errors_plainly()
    tyro.cli(Arguments).run()
