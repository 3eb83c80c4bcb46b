"""``beags bench captures``: from the folders on disk to tables, files and pictures."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

from beags_benchmarks.experiments.captures import made_masks
from beags_benchmarks.experiments.captures.known import PICKED, SALIENT, FoundCapture, find_captures, kinds_of
from beags_benchmarks.experiments.captures.options import CapturesOptions
from beags_benchmarks.experiments.captures.tables import groups, mean_rows, psnr_cost, tables
from beags_benchmarks.experiments.engines import open_engine
from beags_benchmarks.experiments.engines.interface import Engine, Outcome
from beags_benchmarks.experiments.experiment import FILES, Experiment, load_experiment
from beags_benchmarks.experiments.forecast import Forecast
from beags_benchmarks.experiments.options import ExperimentOptions
from beags_benchmarks.experiments.report import provenance, write_csv, write_json
from beags_benchmarks.experiments.results import ResultRow, flat, make_row, report_json, table_rows
from beags_benchmarks.experiments.run import CONSOLE, adapted, print_plan, print_tables, processors, rows_of, trained
from beags_benchmarks.experiments.runner import run_trials
from beags_benchmarks.experiments.scenes import TrialScene
from beags_benchmarks.experiments.trials import Trial, VariantTrial, base_trial, code_of_trials, plan, steps_of
from beags_benchmarks.provenance import busy_note
from beags_plugin.system.errors import UserError
from beags_plugin.system.progress import progress_bar


@dataclasses.dataclass(frozen=True)
class MaskedCapture:
    """A capture with masks of one kind. scene: has these masks. base: training from which objects are picked."""

    found: FoundCapture
    kind: str
    scene: TrialScene
    base: Trial


def run_captures(options: CapturesOptions) -> list[ResultRow]:
    """Run the trials that are not done on every capture on disk, print the tables, write files and pictures.

    Returns the rows; none with ``options.plan``, which writes nothing. Raises ``UserError`` for a mistake in the
    options. A trial that fails is a row with the reason.
    """
    experiment = _experiment(options)
    chosen, lines = find_captures(options)
    for line in lines:
        CONSOLE.print(line)
    captures = _with_masks(experiment, chosen, options)
    source = provenance()
    busy = busy_note(int(source["machine"]["cores"]))  # read before the trials, which keep the machine busy
    with open_engine(options) as engine:
        runs = plan(experiment, [each.scene for each in captures], {}, code_of_trials())
        folder = options.output / "trials"
        sizes = {scene.name: each.found.size for each in captures for scene in (each.found.photos, each.scene)}
        forecast = Forecast(runs, sizes, folder)
        print_plan(forecast.scenes(), "--scenes with the smallest capture", options.plan)
        if options.plan:
            return []
        failed = _make_masks(captures, options.output, engine, forecast)
        possible = [run for run in runs if run.scene.name not in failed]
        outcomes = trained(possible, folder, engine, forecast)
    rows = _rows(runs, outcomes, failed)
    print_tables(tables(rows))
    about = {**source, "busy": busy, "quick": options.quick, "size": options.size, "processors": processors(outcomes)}
    files = {kind: getattr(options, kind) or options.output / f"captures.{kind}" for kind in ("json", "csv")}
    write_json(files["json"], {**report_json(experiment, rows, about), "groups": _groups(rows)})
    write_csv(files["csv"], table_rows(rows))
    for kind, path in {**files, **_pictures(possible, outcomes, options.output)}.items():
        CONSOLE.print(f"{kind}: {path}")
    return rows


def _experiment(options: CapturesOptions) -> Experiment:
    """Return the experiment of the rows, adapted to the options."""
    file = options.rows or FILES / "captures" / "rows.toml"
    wanted = ExperimentOptions(preset=options.preset, variants=options.variants, quick=options.quick)
    experiment = adapted(load_experiment(str(file)), wanted)
    for variant in experiment.variants:
        if variant.has_other_masks or variant.per_object:
            trait = "trains each object alone" if variant.per_object else "has masks of its own"
            raise UserError(f"the rows {file}: {variant.name!r} {trait}, which captures do not: take it out.")
    return dataclasses.replace(experiment, name="captures")


def _with_masks(
    experiment: Experiment, chosen: Sequence[FoundCapture], options: CapturesOptions
) -> list[MaskedCapture]:
    """Return the captures with each kind of masks; prints a sentence if salient masks cannot be made here."""
    pairs, code = kinds_of(chosen, options), code_of_trials()
    if any(kind == SALIENT for _, kind in pairs):
        reason = made_masks.salient_unavailable(fetch=not options.plan)
        if reason is not None:
            CONSOLE.print(f"Captures with salient masks are left out: {reason}")
            pairs = [(each, kind) for each, kind in pairs if kind != SALIENT]
    if not pairs:
        raise UserError("no capture is left to train on: the lines above say why.")
    named = (variant for variant in experiment.variants if variant.name == experiment.reference)
    variant = next(named, experiment.variants[0])
    masked = []
    for each, kind in pairs:
        base = base_trial(experiment, variant, each.photos, experiment.seeds[0], code)
        scene = made_masks.masked_scene(each, kind, base, options.output)
        masked.append(MaskedCapture(each, kind, scene, base))
    return masked


def _make_masks(captures: Sequence[MaskedCapture], output: Path, engine: Engine, forecast: Forecast) -> dict[str, str]:
    """Make missing masks and link truths; returns scene to reason where no masks can be made."""
    bases = [each.base for each in captures if each.kind == PICKED]
    with progress_bar("Training bases to pick from, in steps") as progress:
        outcomes = run_trials(bases, output / "trials", steps_of, engine, progress, forecast.needs) if bases else {}
    failed = {}
    for each in captures:
        made_masks.link_truth(each.found, each.kind, output)
        folder = made_masks.masks_folder(each.found, each.kind, each.base, output)
        if folder is None:
            continue
        base = outcomes.get(each.base.digest)
        if base is not None and base.failed is not None:
            failed[each.scene.name] = f"its base failed: {base.failed}"
            continue
        run = None if base is None else base.folder / "run" / "config.yml"
        try:
            for line in made_masks.make_masks_once(each.found, each.kind, folder, run):
                CONSOLE.print(f"{each.scene.name}: {line}")
        except UserError as error:
            failed[each.scene.name] = f"no masks could be made: {error}"
    return failed


def _rows(runs: Sequence[VariantTrial], outcomes: dict[str, Outcome], failed: Mapping[str, str]) -> list[ResultRow]:
    """Return a row for every run, in order."""
    rows = []
    for run in runs:
        if (reason := failed.get(run.scene.name)) is not None:
            rows.append(make_row(run.variant, run.scene.name, run.seed, None, None, reason))
        else:
            rows += rows_of([run], outcomes)
    return rows


def _groups(rows: Sequence[ResultRow]) -> dict[str, dict[str, object]]:
    """Return kind of masks to {"scenes", "means": [row with "psnr_cost"]}, the content of the tables of means."""
    report = {}
    for title, names in groups(list(dict.fromkeys(row.scene for row in rows))).items():
        averaged = mean_rows(rows, names)
        report[title] = {
            "scenes": names,
            "means": [{**flat(row)[0], "psnr_cost": psnr_cost(row, averaged)} for row in averaged],
        }
    return report


def _pictures(runs: Sequence[VariantTrial], outcomes: Mapping[str, Outcome], output: Path) -> dict[str, Path]:
    """Draw a sheet for each scene; returns their paths by "picture of" the scene."""
    from beags_benchmarks.experiments.captures.pictures import write_sheet

    paths = {}
    scenes = list(dict.fromkeys(run.scene.name for run in runs))
    with progress_bar("Drawing captures") as progress:
        for done, scene in enumerate(scenes, start=1):
            path = output / f"captures-{scene.replace(', ', '-')}.jpg"
            if write_sheet(path, [run for run in runs if run.scene.name == scene], outcomes):
                paths[f"picture of {scene}"] = path
            progress(done, len(scenes))
    return paths
