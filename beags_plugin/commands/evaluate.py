"""``beags eval``: figures of runs as tables, JSON, CSV and a picture of the worst views."""

from __future__ import annotations

import csv
import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from io import StringIO
from pathlib import Path

from beags_plugin.commands.answers import CONSOLE
from beags_plugin.evaluation.protocol import Protocol
from beags_plugin.system.errors import UserError, writing
from beags_plugin.system.progress import progress_bar
from beags_plugin.system.whole_files import write_text_atomically

PICTURES = (".png", ".jpg", ".jpeg")


@dataclass(frozen=True)
class Outputs:
    """Files to write; None writes none. worst: number of masks of each kind in the picture."""

    json: Path | None = None
    csv: Path | None = None
    picture: Path | None = None
    worst: int = 6

    def check(self) -> None:
        """Raise ``UserError`` for a file that could not be written, before anything is evaluated; make its folder."""
        if self.picture is not None and self.picture.suffix.lower() not in PICTURES:
            raise UserError(f"the picture {self.picture} is no .png or .jpg: give it such a name.")
        if self.worst < 1:
            raise UserError(f"worst is {self.worst}: give the number of masks in the picture, at least 1.")
        for path in filter(None, (self.json, self.csv, self.picture)):
            with writing(path):
                path.parent.mkdir(parents=True, exist_ok=True)
            if path.is_dir():
                raise UserError(f"{path} is a folder: name the file to write.")


def run_evaluation(
    configs: Sequence[Path], data_set_name: str, protocol: Protocol, outputs: Outputs, data: Path | None = None
) -> None:
    """Evaluate runs, print their tables and write the files; see ``cli.Eval`` for the arguments.

    Raises ``UserError`` for a run, data, a choice or a file that cannot be used.
    """
    from beags_plugin.evaluation.report import CSV_COLUMNS, data_set
    from beags_plugin.evaluation.table import render_data_set, render_run
    from beags_plugin.objects.evaluate import EvaluatedRun
    from beags_plugin.pictures.cells import write_picture
    from beags_plugin.pictures.worst_views import worst_views_picture

    protocol.check()
    outputs.check()
    runs, worst = [], []
    for path, name in zip(configs, scene_names(configs), strict=True):
        evaluated = EvaluatedRun(path, name, data)
        with progress_bar(f"Evaluating {name}") as progress:
            metrics = evaluated.metrics(protocol, progress)
        if outputs.picture is not None:
            with progress_bar("Drawing worst masks") as progress:
                worst += evaluated.worst(metrics, outputs.worst, progress=progress)
        runs.append(metrics)
        CONSOLE.print(render_run(metrics))
    scores = data_set(data_set_name, runs)
    if len(runs) > 1:
        CONSOLE.print(render_data_set(scores))
    if outputs.json is not None:
        _write(outputs.json, json.dumps(scores.to_json(), indent=1, allow_nan=False))
    if outputs.csv is not None:
        text = StringIO()
        csv.writer(text, lineterminator="\n").writerows([CSV_COLUMNS, *scores.csv_rows()])
        _write(outputs.csv, text.getvalue().rstrip("\n"))
    if outputs.picture is not None and worst:
        write_picture(outputs.picture, worst_views_picture(worst, outputs.worst))
        CONSOLE.print(f"picture: {outputs.picture}")
    elif outputs.picture is not None:
        CONSOLE.print("No picture: no mask was scored.")


def scene_names(configs: Sequence[Path]) -> list[str]:
    """Return the name of each run's data folder, with the run's folder where names would be equal.

    Raises ``UserError`` for a file that is no run's config, and for a run given twice.
    """
    from beags_plugin.objects.evaluate import scene_name
    from beags_plugin.runs.relocation import open_run

    if not configs:
        raise UserError("no run is named: give --load-config the config.yml of at least one.")
    names = [scene_name(open_run(path)) for path in configs]
    if repeated := [path for path, count in Counter(path.resolve() for path in configs).items() if count > 1]:
        raise UserError(f"{repeated[0]} is given twice: name each run once.")
    for longer in (lambda path: path.resolve().parent.name, lambda path: str(path.parent)):
        shared = {name for name, count in Counter(names).items() if count > 1}
        names = [
            f"{name} ({longer(path)})" if name in shared else name for name, path in zip(names, configs, strict=True)
        ]
    return names


def _write(path: Path, text: str) -> None:
    write_text_atomically(f"{text}\n", path)
    CONSOLE.print(f"figures: {path}")
