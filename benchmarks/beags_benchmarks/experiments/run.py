"""``beags bench``: from an experiment's name to its tables, files and pictures."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table

from beags_benchmarks.experiments.engines import open_engine
from beags_benchmarks.experiments.engines.interface import Engine, Outcome
from beags_benchmarks.experiments.experiment import Experiment, Variant, check_keys, load_experiment
from beags_benchmarks.experiments.forecast import Forecast, SceneForecast
from beags_benchmarks.experiments.options import ExperimentOptions
from beags_benchmarks.experiments.per_object import merged
from beags_benchmarks.experiments.plan_table import plan_lines, plan_table
from beags_benchmarks.experiments.report import provenance, write_csv, write_json
from beags_benchmarks.experiments.results import ResultRow, make_row, report_json, table_rows
from beags_benchmarks.experiments.runner import run_trials
from beags_benchmarks.experiments.scenes import (
    TrialScene,
    class_masks,
    damaged_masks,
    given_scenes,
    sample_scene,
    scene_size,
)
from beags_benchmarks.experiments.trials import MODEL, VariantTrial, code_of_trials, plan, steps_of
from beags_benchmarks.provenance import busy_note
from beags_plugin.system.errors import UserError, check_choice
from beags_plugin.system.progress import progress_bar

CONSOLE = Console(soft_wrap=True, highlight=False, markup=False)  # paths may hold brackets
TABLE_WIDTH = 256  # lines that a narrow terminal breaks are better than truncated cells
QUICK_SAMPLE = {"width": 96, "height": 72, "num_train": 16, "num_test": 3}
QUICK_BASE = {"base_steps": 220, "schedule_steps": 0, "densify.start": 50, "densify.stop": 180}
QUICK_REFINE = {"refine_steps": 10}
EVERY = "all"  # value of --variants for all, unless a variant has that name
QUICK_MOST = 30  # most steps of variants that set their number


def run_experiment(name: str, options: ExperimentOptions) -> list[ResultRow]:
    """Run the trials of an experiment that are not done, print its tables and write its files; returns the rows.

    With ``options.plan`` it prints the plan: nothing is written, no trial runs, and there are no rows. Raises
    ``UserError`` for a mistake in the experiment or the options. A trial that fails is a row with the reason.
    """
    from beags_benchmarks.experiments.confidence import plot_confidence
    from beags_benchmarks.experiments.objects_picture import plot_objects
    from beags_benchmarks.experiments.pictures import plot_experiment
    from beags_benchmarks.experiments.tables import tables

    experiment = adapted(load_experiment(name), options)
    source = provenance()
    busy = busy_note(int(source["machine"]["cores"]))  # read before the trials, which keep the machine busy
    if busy:
        CONSOLE.print(f"Note: {busy}.")
    with open_engine(options) as engine:
        scenes = scenes_of(experiment, options)
        masks = {
            (scene.name, variant.name): folders
            for scene in scenes
            for variant in experiment.variants
            if (folders := _other_masks(scene, variant, options.output / "scenes", not options.plan)) is not None
        }
        runs = plan(experiment, scenes, masks, code_of_trials())
        trials_folder = options.output / "trials"
        forecast = Forecast(runs, {scene.name: scene_size(scene) for scene in scenes}, trials_folder)
        print_plan(forecast.scenes(), "--scenes 1", options.plan)
        if options.plan:
            return []
        outcomes = trained(runs, trials_folder, engine, forecast)
    rows = rows_of(runs, outcomes)
    print_tables(tables(experiment, rows))
    files = options.files(experiment.name)
    picture = files["picture"]
    about = {**source, "busy": busy, "quick": options.quick, "processors": processors(outcomes)}
    write_json(files["json"], report_json(experiment, rows, about))
    write_csv(files["csv"], table_rows(rows))
    plot_experiment(picture, experiment, rows)
    if experiment.confidence:
        files["confidence"] = picture.with_stem(f"{picture.stem}-confidence")
        plot_confidence(files["confidence"], runs, outcomes)
    if experiment.objects:
        paths = plot_objects(picture.with_stem(f"{picture.stem}-objects"), runs, outcomes)
        files |= {f"objects {place}" if place > 1 else "objects": path for place, path in enumerate(paths, start=1)}
    for kind, path in files.items():
        CONSOLE.print(f"{kind}: {path}")
    return rows


def print_plan(forecasts: Sequence[SceneForecast], smallest: str, table: bool) -> None:
    """Print what the trials will take; smallest: see ``plan_lines``. table: scene by scene too."""
    if table:
        print_tables([plan_table(forecasts)])
    for line in plan_lines(forecasts, smallest):
        CONSOLE.print(line)


def trained(runs: Sequence[VariantTrial], folder: Path, engine: Engine, forecast: Forecast) -> dict[str, Outcome]:
    """Run the trials that are not done, with a progress bar; folder: holds all trials. Returns outcomes by digest."""
    trials = [trial for run in runs for trial in run.trials]
    with progress_bar("Training, in steps") as progress:
        outcomes = run_trials(trials, folder, steps_of, engine, progress, forecast.needs)
    if len(names := processors(outcomes)) > 1:
        CONSOLE.print(f"Note: trials ran on {' and '.join(names)}, which round differently.")
    return outcomes


def processors(outcomes: Mapping[str, Outcome]) -> list[str]:
    """Return the names of the processors or GPUs that trained."""
    results = [outcome.result for outcome in outcomes.values() if outcome.result is not None]
    return sorted({result["processor"] for result in results if "processor" in result})


def print_tables(tables: Sequence[Table | str]) -> None:
    """Print tables at ``TABLE_WIDTH`` or more, and sentences between them."""
    wide = Console(width=max(CONSOLE.width, TABLE_WIDTH), highlight=False, markup=False)
    for table in tables:
        (CONSOLE if isinstance(table, str) else wide).print(table)


def _other_masks(scene: TrialScene, variant: Variant, folder: Path, write: bool) -> Path | None:
    """Return the folder of a variant's own masks; None for the scene's masks."""
    if variant.classes is not None:
        return class_masks(scene, variant.classes, folder, write)
    return None if variant.damage is None else damaged_masks(scene, variant.damage, folder, write)


def adapted(experiment: Experiment, options: ExperimentOptions) -> Experiment:
    """Return the experiment with the variants, the preset and, for --quick, the tiny sizes of the options."""
    known = [variant.name for variant in experiment.variants]
    if options.variants and (EVERY in known or EVERY not in options.variants):
        known += [name for name in dict.fromkeys(each.split(", ")[0] for each in known) if name not in known]
        for name in options.variants:
            check_choice(name, known, "variant", f" of {experiment.name}")
        wanted = {*options.variants, experiment.reference}  # "cob-gs" stands for "cob-gs, one scene" too
        chosen = tuple(v for v in experiment.variants if {v.name, v.name.split(", ")[0]} & wanted)
        controls = {variant.control for variant in chosen}
        chosen = tuple(v for v in experiment.variants if v in chosen or v.name in controls)
        experiment = dataclasses.replace(experiment, variants=chosen)
    if options.preset is not None:
        experiment = dataclasses.replace(experiment, preset=options.preset)
        check_keys(experiment, Path(f"{experiment.name}.toml"))
    if not options.quick:
        return experiment
    base = {MODEL + key: value for key, value in QUICK_BASE.items()}
    refine = {MODEL + key: value for key, value in QUICK_REFINE.items()}

    def short(variant: Variant) -> Variant:
        changed = {**refine, **variant.refine}
        changed[MODEL + "refine_steps"] = min(changed[MODEL + "refine_steps"], QUICK_MOST)
        return dataclasses.replace(variant, base={**variant.base, **base}, refine=changed)

    variants = tuple(map(short, _thinned(experiment.variants)))
    sample = {**experiment.sample, **QUICK_SAMPLE}
    return dataclasses.replace(experiment, variants=variants, sample=sample, samples=experiment.samples[:1], of_seed={})


def _thinned(variants: Sequence[Variant]) -> list[Variant]:
    """Return all plain variants, and the first and the last of each line of a sweep."""
    lines: dict[tuple[str, str], list[Variant]] = {}
    for variant in variants:
        key = (variant.sweep, variant.line) if variant.sweep else (variant.name, "")
        lines.setdefault(key, []).append(variant)
    return [variant for line in lines.values() for variant in [*line[:1], *line[1:][-1:]]]


def scenes_of(experiment: Experiment, options: ExperimentOptions) -> list[TrialScene]:
    """Return the experiment's samples (none by default if the user gives data) and the user's folders.

    A plan writes no sample. Raises ``UserError`` if there are no scenes, or fewer samples than requested.
    """
    given = given_scenes(options.data, options.downscale)
    count = options.scenes if options.scenes is not None else (0 if given else len(experiment.samples))
    if not 0 <= count <= len(experiment.samples):
        raise UserError(f"--scenes is {count}, but {experiment.name} names {len(experiment.samples)} sample scenes.")
    folder = options.output / "scenes"
    samples = [
        sample_scene(folder, family, seed, {**experiment.sample, **experiment.of_seed.get(seed, {})}, not options.plan)
        for family, seed in experiment.samples[:count]
    ]
    if not samples and not given:
        raise UserError("there is no scene to train on: name a folder with --data, or give --scenes 1 or more.")
    return samples + given


def rows_of(runs: Sequence[VariantTrial], outcomes: dict[str, Outcome]) -> list[ResultRow]:
    """Return a row for every run, in order."""
    rows = []
    for run in runs:
        assert run.trial.base is not None
        base, own = outcomes[run.trial.base.digest], [outcomes[trial.digest] for trial in run.trials]
        failed = next((outcome.failed for outcome in own if outcome.failed), None)
        result = own[0].result if failed is None else None
        if run.objects and result is not None:
            results = zip(run.objects, (outcome.result for outcome in own), strict=True)
            result = merged({name: each for name, each in results if each is not None})
        rows.append(make_row(run.variant, run.scene.name, run.seed, base.result, result, failed))
    return rows
