"""python -m benchmarks.time_to_quality: CPU seconds until a base is as good as that of the official schedule."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from rich.console import Console

from beags_plugin.bench.experiment import load_experiment
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
from beags_plugin.bench.run import TABLE_WIDTH, adapted
from beags_plugin.system.errors import UserError, print_user_errors_plainly
from benchmarks.base_training import Curve, CurveRow, curve_json, train_rows

CONSOLE = Console(soft_wrap=True, highlight=False, markup=False)  # paths may hold brackets
MARGINS = (0.2, 0.5)  # dB below the end of the reference variant
MEAN = "mean"  # in the column "scene"


def run(name: str, options: ExperimentOptions) -> list[dict[str, Any]]:
    """Train the bases that are not done, print a table and write its files; returns the table's lines.

    name: of a TOML file, or an experiment; it must name a reference variant. Raises ``UserError`` for a mistake in it
    or in the options.
    """
    experiment = adapted(load_experiment(name), options)
    if (reference := experiment.reference) is None:
        raise UserError(f"the experiment {experiment.name} has no reference to compare with: name one of its variants.")
    source = {**provenance(), "quick": options.quick}  # before the trials: they keep the machine busy
    rows = train_rows(experiment, options)
    lines = report_lines(rows, reference)
    wide = Console(width=max(CONSOLE.width, TABLE_WIDTH), highlight=False, markup=False)
    wide.print(plain_table(f"{experiment.name}: beside {reference!r}", _HEADS, [cells(line) for line in lines]))
    wide.print("CPU s: of training alone. To -0.2 dB: CPU seconds until that far below the reference's last PSNR.")
    files = options.files(experiment.name)
    write_json(files["json"], {**experiment.header(), "reference": reference, **source, "rows": lines,
                               "curves": curve_json(rows)})  # fmt: skip
    write_csv(files["csv"], lines)
    plot(files["picture"], rows, reference)
    for kind, path in files.items():
        CONSOLE.print(f"{kind}: {path}")
    return lines


def seconds_to(curve: Curve, psnr: float) -> float | None:
    """Return the CPU seconds at which a curve first reaches ``psnr`` dB, between two measurements on a straight line.

    None if it never does.
    """
    before: Mapping[str, float] | None = None
    for record in curve:
        if record["psnr"] >= psnr:
            if before is None:
                return record["cpu_seconds"]
            share = (psnr - before["psnr"]) / (record["psnr"] - before["psnr"])
            return before["cpu_seconds"] + share * (record["cpu_seconds"] - before["cpu_seconds"])
        before = record
    return None


def report_lines(rows: Sequence[CurveRow], reference: str) -> list[dict[str, Any]]:
    """Return a line per row, then the means of each variant (scene "mean").

    Besides the figures at the row's end, each has, against the reference variant's end on the same scene and seed:
    "behind", dB; "gaussians_share", "cpu_share"; and for each of ``MARGINS`` "cpu_to_-0.2", CPU seconds until that far
    below it, and "share_to_-0.2" of the reference's whole CPU seconds. A figure is None where it is unknown or the
    quality was not reached. Means are over the scenes that have the figure; "reached_-0.2" counts these, and "count"
    all scenes.
    """
    ends = {(row.scene, row.seed): row.curve[-1] for row in rows if row.variant == reference and row.curve}
    lines = [_line(row, ends.get((row.scene, row.seed))) for row in rows]
    variants = dict.fromkeys(row.variant for row in rows)
    return lines + [_mean(variant, [line for line in lines if line["variant"] == variant]) for variant in variants]


def _line(row: CurveRow, end: Mapping[str, float] | None) -> dict[str, Any]:
    last = row.curve[-1] if row.curve else None
    line: dict[str, Any] = {"scene": row.scene, "seed": row.seed, "variant": row.variant, "failed": row.failed}
    line |= {name: None if last is None else last[key] for name, key in _ENDS.items()}
    line["peak_memory_mb"] = row.peak_memory_mb
    line |= {"behind": None, "gaussians_share": None, "cpu_share": None}
    if last is not None and end is not None:
        line["behind"] = end["psnr"] - last["psnr"]
        line["gaussians_share"] = last["gaussians"] / end["gaussians"]
        line["cpu_share"] = last["cpu_seconds"] / end["cpu_seconds"]
    for margin in MARGINS:
        taken = None if end is None else seconds_to(row.curve, end["psnr"] - margin)
        line[f"cpu_to_-{margin}"] = taken
        line[f"share_to_-{margin}"] = None if taken is None or end is None else taken / end["cpu_seconds"]
        line[f"reached_-{margin}"] = int(taken is not None)
    return {**line, "count": 1}


def _mean(variant: str, lines: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    whole = {"scene": MEAN, "seed": None, "variant": variant, "failed": None}
    mean: dict[str, Any] = {**dict.fromkeys(lines[0]), **whole}
    for name in mean:
        known = [line[name] for line in lines if name not in whole and line[name] is not None]
        if known:
            mean[name] = sum(known) / len(known)
    counts = {name: sum(line[name] for line in lines) for name in (*(f"reached_-{m}" for m in MARGINS), "count")}
    return {**mean, **counts}


_ENDS = {"steps": "step", "gaussians": "gaussians", "psnr": "psnr", "ssim": "ssim", "cpu_seconds": "cpu_seconds"}
_HEADS = (
    "scene", "variant", "steps", "Gaussians", "share, %", "PSNR, dB", "SSIM", "behind, dB", "CPU s", "share, %",
    *(f"to -{margin} dB, s ({what})" for margin in MARGINS for what in ("share, %",)), "memory, MB",
)  # fmt: skip


def cells(line: Mapping[str, Any]) -> list[str]:
    """Return one line of the table as text."""
    name = line["variant"] if line["failed"] is None else f"{line['variant']} failed: {line['failed']}"
    figures = (
        ("steps", 0, 1.0), ("gaussians", 0, 1.0), ("gaussians_share", 0, 100.0), ("psnr", 2, 1.0), ("ssim", 3, 1.0),
        ("behind", 2, 1.0), ("cpu_seconds", 0, 1.0), ("cpu_share", 0, 100.0),
    )  # fmt: skip
    found = [line["scene"], name, *(number(line[key], digits, factor) for key, digits, factor in figures)]
    for margin in MARGINS:
        seconds, share = line[f"cpu_to_-{margin}"], line[f"share_to_-{margin}"]
        reached, count = line[f"reached_-{margin}"], line["count"]
        of = f", {reached} of {count} scenes" if count > 1 and reached < count else ""
        found.append("–" if seconds is None else f"{seconds:.0f} ({100 * share:.0f}{of})")
    return [*found, number(line["peak_memory_mb"], 0)]


def plot(path: Path, rows: Sequence[CurveRow], reference: str) -> None:
    """Plot, for each scene, PSNR and SSIM of held-out views and the number of Gaussians over CPU seconds."""
    scenes = list(dict.fromkeys(row.scene for row in rows))
    variants = list(dict.fromkeys(row.variant for row in rows))
    figures = (("psnr", "PSNR, dB"), ("ssim", "SSIM"), ("gaussians", "Gaussians"))
    figure, axes = new_figure(len(scenes), len(figures))
    for column, scene in enumerate(scenes):
        own = [row for row in rows if row.scene == scene and row.curve]
        for line, (key, title) in enumerate(figures):
            panel = axes[line][column]
            for row in own:
                x, y = ([record[name] for record in row.curve] for name in ("cpu_seconds", key))
                panel.plot(x, y, ".-", ms=3, lw=1, color=f"C{variants.index(row.variant)}", label=row.variant)
                if key == "psnr" and row.variant == reference:
                    for margin in MARGINS:
                        panel.axhline(y[-1] - margin, color="0.6", lw=0.8, ls=":")
            panel.set_xscale("log")
            panel.xaxis.set_minor_formatter("")  # a short axis has no room for these
            panel.set_title(f"{scene}: {title}", fontsize="medium")
        axes[-1][column].set_xlabel("CPU seconds")
    handles = [axes[0][0].plot([], [], ".-", color=f"C{number}")[0] for number in range(len(variants))]
    figure.legend(handles, variants, loc="outside lower center", fontsize="small", ncols=2)
    save_figure(path, figure)


@dataclass
class Arguments(ExperimentOptions):
    """Measure the CPU seconds that bases take to the quality of a reference's end."""

    file: tyro.conf.Positional[str] = "benchmarks/time-to-quality.toml"
    """A TOML file with a reference; by default the official schedule, beags-fast and its means."""

    def run(self) -> None:
        """Train and report."""
        run(self.file, self)


if __name__ == "__main__":
    print_user_errors_plainly()
    tyro.cli(Arguments).run()
