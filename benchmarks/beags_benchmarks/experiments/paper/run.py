"""``beags bench paper``: from the folders on disk to the paper's tables."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from beags_benchmarks.experiments.engines import open_engine
from beags_benchmarks.experiments.engines.interface import Engine, Outcome
from beags_benchmarks.experiments.engines.trial_folder import finished, read_json
from beags_benchmarks.experiments.experiment import Experiment, load_experiment
from beags_benchmarks.experiments.forecast import Forecast
from beags_benchmarks.experiments.options import ExperimentOptions
from beags_benchmarks.experiments.paper.data_sets import METHODS, PaperDataSet, paper_folder, read_data_sets
from beags_benchmarks.experiments.paper.on_disk import TRUTH, SceneOnDisk, Sizes, find_scenes
from beags_benchmarks.experiments.paper.options import PaperOptions
from beags_benchmarks.experiments.paper.tables import (
    KINDS,
    Outcomes,
    mean_row,
    missing_lines,
    paper_tables,
)
from beags_benchmarks.experiments.report import provenance, write_csv, write_json
from beags_benchmarks.experiments.results import protocol_of, report_json, table_rows
from beags_benchmarks.experiments.run import CONSOLE, adapted, print_plan, print_tables, processors, rows_of, trained
from beags_benchmarks.experiments.trials import VariantTrial, code_of_trials, plan
from beags_benchmarks.provenance import busy_note
from beags_plugin.system.digests import folder_digest
from beags_plugin.system.errors import UserError
from beags_plugin.system.whole_files import write_text_atomically

SCORED_BY = "measured.json"  # file in a trial's folder with the digest of the truth of its scores


def run_paper(options: PaperOptions) -> Outcomes | None:
    """List what is missing, print the plan, run what is on disk, and print the tables; None with ``options.plan``.

    Raises ``UserError`` for a mistake in the options. A trial that fails is a row with the reason.
    """
    if not (math.isfinite(options.downscale) and options.downscale >= 1.0):
        raise UserError(f"downscale is {options.downscale}: give 1 (the paper's sizes) or more.")
    data_sets = read_data_sets(options.data_set)
    experiment = _methods(options)
    with open_engine(options) as engine:
        return _run(options, data_sets, experiment, engine)


def _run(
    options: PaperOptions, data_sets: Sequence[PaperDataSet], experiment: Experiment, engine: Engine
) -> Outcomes | None:
    """Run the experiment on an open engine; see ``run_paper``."""
    scenes = find_scenes(
        data_sets, options.data_root, options.output, Sizes(options.downscale, options.quick), options.scenes
    )
    for line in missing_lines(scenes):
        CONSOLE.print(line)
    present = [scene for scene in scenes if scene.scene is not None]
    if not present:
        raise UserError(f"no scene in {options.data_root} is complete: the lines above say what belongs where.")
    runs = plan(experiment, [scene.scene for scene in present if scene.scene is not None], {}, code_of_trials())
    trials_folder = options.output / "trials"
    forecast, titles = forecast_of(present, runs, trials_folder)
    print_plan(forecast.scenes(titles), "--scenes with the smallest scene", True)
    if options.plan:
        return None
    source = provenance()
    busy = busy_note(int(source["machine"]["cores"]))  # read before the trials, which keep the machine busy
    truths = _truths(runs)
    _score_again(runs, truths, trials_folder)
    trials = trained(runs, trials_folder, engine, forecast)
    for digest, truth in truths.items():
        if trials[digest].result is not None:
            write_text_atomically(json.dumps({"truth": truth}), trials[digest].folder / SCORED_BY)
    rows = rows_of(runs, trials)
    outcomes = Outcomes(rows, {(run.scene.name, run.variant.name): _truth(run, trials) for run in runs})
    methods = [variant.name for variant in experiment.variants]
    print_tables(paper_tables(data_sets, methods, outcomes))
    for line in _lines(experiment, options, outcomes):
        CONSOLE.print(line)
    files = {kind: getattr(options, kind) or options.output / f"paper.{kind}" for kind in ("json", "csv")}
    about = {**source, "busy": busy, "quick": options.quick, "downscale": options.downscale}
    about["processors"] = processors(trials)
    report = {**report_json(experiment, rows, about), "data_sets": _report(data_sets, scenes, methods, outcomes)}
    write_json(files["json"], report)
    write_csv(files["csv"], table_rows(rows))
    for kind, path in files.items():
        CONSOLE.print(f"{kind}: {path}")
    return outcomes


def forecast_of(
    scenes: Sequence[SceneOnDisk], runs: Sequence[VariantTrial], folder: Path
) -> tuple[Forecast, dict[str, str]]:
    """Return the forecast of the trials in ``folder``, and titles of the scenes by name."""
    by_name = {scene.scene.name: scene for scene in scenes if scene.scene is not None}
    sizes = {name: scene.size for name, scene in by_name.items()}
    return Forecast(runs, sizes, folder), {n: f"{scene.data_set.title}, {scene.name}" for n, scene in by_name.items()}


def _methods(options: PaperOptions) -> Experiment:
    """Return the experiment of the methods, as the options want it."""
    experiment = load_experiment(str(paper_folder() / f"{METHODS}.toml"))
    wanted = ExperimentOptions(preset=options.preset, variants=options.methods, quick=options.quick)
    return dataclasses.replace(adapted(experiment, wanted), name="paper")


def _truths(runs: Sequence[VariantTrial]) -> dict[str, str]:
    """Return a digest of the truth on disk for each trial; its masks may be newer than the training."""
    folders = {run.scene.name: run.scene.data / TRUTH for run in runs}
    digests = {name: folder_digest(folder) if folder.is_dir() else "" for name, folder in folders.items()}
    return {trial.digest: digests[run.scene.name] for run in runs for trial in run.trials}


def _score_again(runs: Sequence[VariantTrial], truths: Mapping[str, str], folder: Path) -> None:
    """Mark trials whose truth has changed to be scored again: they keep their training but lose their result."""
    changed = 0
    for trial in (trial for run in runs for trial in run.trials):
        place = folder / trial.folder_name
        if (result := finished(place)) is None or (read_json(place / SCORED_BY) or {}).get("truth") == truths[
            trial.digest
        ]:
            continue
        if not (place / "trained.json").exists():  # an older version wrote no such file
            write_text_atomically(json.dumps(result), place / "trained.json")
        (place / "result.json").unlink()
        changed += 1
    if changed:
        CONSOLE.print(f"{changed} trials are scored again, without training: their truth has changed.")


def _truth(run: VariantTrial, outcomes: Mapping[str, Outcome]) -> str | None:
    """Return the kind of truth of a run's extracted masks; None if nothing was compared."""
    results = (outcomes[trial.digest].result for trial in run.trials)
    truths = {result["evaluation"]["extracted_truth"] for result in results if result is not None} - {None}
    return "both" if len(truths) > 1 else next(iter(truths), None)


def _lines(experiment: Experiment, options: PaperOptions, outcomes: Outcomes) -> list[str]:
    """Return the notes below the tables: the protocol, deviations from the paper, and failures."""
    protocol = protocol_of(outcomes.rows)
    lines = [] if protocol is None else [protocol]
    if options.quick or options.downscale != 1.0 or experiment.preset != "beags-paper":
        how = "in a trial run" if options.quick else f"with {experiment.preset}, sizes / {options.downscale:g}"
        lines.append(f"Trained {how}: ours are not figures of the paper's protocol.")
    lines.append(f"Acc, single scenes and objects are in the files. {paper_folder()} says what the paper leaves open.")
    return lines + [f"failed: {row.variant.name} on {row.scene}: {row.failed}" for row in outcomes.rows if row.failed]


def _report(
    data_sets: Sequence[PaperDataSet], scenes: Sequence[SceneOnDisk], methods: Sequence[str], outcomes: Outcomes
) -> dict[str, Any]:
    """Return, by data set, {"title", "open", "scenes": {name: [truth]}, "missing", "ours", "paper", "psnr"}."""
    report = {}
    for data_set in data_sets:
        own = [scene for scene in scenes if scene.data_set.name == data_set.name]
        rows = {method: mean_row(data_set, method, outcomes) for method in methods}
        report[data_set.name] = {
            "title": data_set.title,
            "open": dict(data_set.open),
            "scenes": [scene.name for scene in own if scene.scene is not None],
            "missing": missing_lines(own),
            "extracted_truth": {
                f"{scene} {method}": truth
                for (scene, method), truth in outcomes.truths.items()
                if scene.split("/")[0] == data_set.name
            },
            "ours": {
                kind: {
                    method: [row.figures[f"{kind}_{metric}_after"] for metric in ("acc", "iou", "biou")]
                    for method, row in rows.items()
                    if row is not None
                }
                for kind in KINDS
            },
            "paper": {kind: dict(data_set.figures.get(kind, {})) for kind in KINDS} | {"psnr": data_set.psnr},
        }
    return report
