"""``beags eval``: figures of a run as tables, JSON and a picture of the worst views."""

from __future__ import annotations

import json
from dataclasses import dataclass
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
    picture: Path | None = None
    worst: int = 6

    def check(self) -> None:
        """Raise ``UserError`` for a file that could not be written, before anything is evaluated; make its folder."""
        if self.picture is not None and self.picture.suffix.lower() not in PICTURES:
            raise UserError(f"the picture {self.picture} is no .png or .jpg: give it such a name.")
        if self.worst < 1:
            raise UserError(f"worst is {self.worst}: give the number of masks in the picture, at least 1.")
        for path in filter(None, (self.json, self.picture)):
            with writing(path):
                path.parent.mkdir(parents=True, exist_ok=True)
            if path.is_dir():
                raise UserError(f"{path} is a folder: name the file to write.")


def run_evaluation(config: Path, protocol: Protocol, outputs: Outputs, data: Path | None = None) -> None:
    """Evaluate a run, print its tables and write the files; see ``of_runs.Eval`` for the arguments.

    Raises ``UserError`` for a run, data, a choice or a file that cannot be used.
    """
    from beags_plugin.evaluation.table import render_run
    from beags_plugin.objects.evaluate import EvaluatedRun
    from beags_plugin.pictures.cells import write_picture
    from beags_plugin.pictures.worst_views import worst_views_picture

    protocol.check()
    outputs.check()
    evaluated, worst = EvaluatedRun(config, data), []
    with progress_bar(f"Evaluating {evaluated.name}") as progress:
        metrics = evaluated.metrics(protocol, progress)
    if outputs.picture is not None:
        with progress_bar("Drawing worst masks") as progress:
            worst = evaluated.worst(metrics, outputs.worst, progress=progress)
    CONSOLE.print(render_run(metrics))
    if outputs.json is not None:
        write_text_atomically(json.dumps(metrics.to_json(), indent=1, allow_nan=False) + "\n", outputs.json)
        CONSOLE.print(f"figures: {outputs.json}")
    if outputs.picture is not None and worst:
        write_picture(outputs.picture, worst_views_picture(worst, outputs.worst))
        CONSOLE.print(f"picture: {outputs.picture}")
    elif outputs.picture is not None:
        CONSOLE.print("No picture: no mask was scored.")
