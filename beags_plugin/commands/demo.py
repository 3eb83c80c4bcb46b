"""``beags demo``: sample, training, extraction, measurement, one table and one picture."""

from __future__ import annotations

import json
import math
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from rich.console import Console

from beags_plugin.system.child_processes import bound
from beags_plugin.system.digests import code_digest, value_digest
from beags_plugin.system.errors import UserError, check_choice
from beags_plugin.system.lock import run_lock
from beags_plugin.system.pasted import command, quoted
from beags_plugin.system.progress import progress_bar
from beags_plugin.system.whole_files import write_text_atomically

if TYPE_CHECKING:
    from beags_plugin.commands.scene_setup import MadeScene
    from beags_plugin.core.surfels import Surfels
    from beags_plugin.objects.evaluate import EvaluatedRun
    from beags_plugin.objects.extract import Extracted
    from beags_plugin.plugin.options.model_options import BeagsModelConfig

CONSOLE = Console(soft_wrap=True, highlight=False, markup=False)  # paths may hold brackets
STAMP = "trained.json"  # beside the run: the request that it was made from
STARTED = "started"  # in there, holds the request until the training ends
PRESET, PRESET_OF_PHOTOS = "beags-tiny", "beags-fast"
AGREE = ("--pipeline.model.prepare.agree", "True")  # a network's masks err in many views alike
QUIET = ("--logging.steps-per-log", "50", "--logging.local-writer.max-log-size", "0")  # where no table can be redrawn


def run_demo(
    data: Path | None, output: Path | None, preset: str | None, downscale: float | None, seed: int, fresh: bool,
    strict: bool = False,
) -> None:  # fmt: skip
    """Run the whole demo in ``output`` and print the table; see ``cli.Demo`` for the arguments."""
    from beags_plugin.commands.scene_setup import MadeScene, made_scene, name_of
    from beags_plugin.data.layout import read_dataset
    from beags_plugin.data.quick import quick_downscale
    from beags_plugin.runs.prepared import photos_contradict
    from beags_plugin.sample.writer import make_sample

    preset = preset or (PRESET if data is None else PRESET_OF_PHOTOS)
    check_preset(preset)
    if downscale is not None and not 1.0 <= downscale < math.inf:
        raise UserError(f"downscale is {downscale}: give 1 (full size) or more.")
    seconds: dict[str, float] = {}
    if data is None:
        output = output or Path("outputs/demo")
        scene = MadeScene(output / "sample")
        with timed(seconds, "sample"):
            make_sample(scene.data, seed, 256, 192, "mild")
        downscale = downscale or 1.0
    else:
        output = output or Path("outputs") / name_of(data)
        if output.resolve() == data.resolve():
            raise UserError(f"{output} is the data: give another --output.")
        with timed(seconds, "poses and masks"):
            scene = made_scene(data, output)
        if strict:
            check_contradictions(scene, output)
        read_dataset(scene.data)  # reports what is missing before a training starts
        downscale = downscale or quick_downscale(scene.data)
    run = output / "run"
    request = {"preset": preset, "downscale": downscale, "inputs": _digest(scene, output, preset)}
    alone = {**request, "photos": "objects"}
    if scene.turned or (alone in (former := _read_stamp(output), former.get(STARTED)) and not fresh):
        request = alone
    _train_once(scene, output, request, fresh)
    if request != alone and photos_contradict(run):
        CONSOLE.print(
            "The photos contradict each other outside the masks, as on a turntable: now with the objects' pixels alone."
        )
        _train_once(scene, output, alone, fresh, replace=True)
    measure(run, output, seconds, scene)


def check_contradictions(scene: MadeScene, output: Path) -> None:
    """Raise ``UserError`` where the views contradict masks, as the points say that several saw (``beags masks check``).

    output: of the demo, which gets contradicted.png.
    """
    from beags_plugin.objects.check_masks import check_scene, options_beside, write_contradictions

    masks = None if scene.labels is None else (scene.labels / "masks").absolute()
    report = check_scene(options_beside(None, scene.data, masks_path=masks))
    views = list(dict.fromkeys(one.view for one in report.contradictions))
    if views:
        picture = write_contradictions(report, output)[0]
        named = ", ".join(views[:6]) + (f" and {len(views) - 6} more" if len(views) > 6 else "")
        raise UserError(
            f"{len(views)} masks contradict the others ({named}; see {picture}): correct or delete them, or leave "
            "--strict out."
        )


def _train_once(scene: MadeScene, output: Path, request: dict[str, Any], fresh: bool, replace: bool = False) -> None:
    """Train what is requested, unless that was done before, or resume it.

    replace: the run that lies there is a step on the way to this one. Raises ``UserError`` where another run, trained
    to its end, would be replaced.
    """
    run = output / "run"
    if not fresh and _trained(output, request):
        CONSOLE.print(f"Trained before: {run} (add --fresh to train again).")
        return
    if run.exists() and not (output / STAMP).exists():
        raise UserError(f"{run} is not the demo's: choose another --output, or move it away.")
    if run.is_dir():
        run_lock(run).release()  # refuses if the same demo is being trained
    if not fresh and _interrupted(output, request):
        resume(run)
    else:
        if (run / "training.json").exists() and not (fresh or replace):
            raise UserError(
                f"{run} holds a run that was trained {_difference(_read_stamp(output), request)}: add --fresh to "
                "replace it, or choose another --output."
            )
        shutil.rmtree(run, ignore_errors=True)
        write_stamp(output, {STARTED: request})
        train(scene, run, request["preset"], request["downscale"], request.get("photos", "all"))
    write_stamp(output, request)


def check_preset(preset: str) -> None:
    """Raise ``UserError`` unless the preset trains a base and refines it, which is what the demo compares."""
    from beags_plugin.plugin.presets import load_preset, preset_names

    check_choice(preset, preset_names(), "preset")
    model = cast("BeagsModelConfig", load_preset(preset).config.pipeline.model)
    if not (model.base_steps and model.refine_steps):
        raise UserError(f"the demo compares a base with its refinement, and {preset} trains only one: take beags-tiny.")


def _digest(scene: MadeScene, output: Path, preset: str) -> str:
    """Return what changes with the preset, the package's code and any file of the data (by name, size and time)."""
    from beags_plugin.plugin.presets import preset_files

    texts = [path.read_text("utf8") for path in preset_files(preset)]
    return value_digest([*scene.digests(output), code_digest(), *texts])


def write_stamp(output: Path, content: dict[str, Any]) -> None:
    """Write the request that the run in ``output`` was made from, or, under ``STARTED``, is being made from."""
    write_text_atomically(json.dumps(content), output / STAMP)


def _read_stamp(output: Path) -> dict[str, Any]:
    try:
        former = json.loads((output / STAMP).read_text())
    except (OSError, ValueError):
        return {}
    return former if isinstance(former, dict) else {}


def _trained(output: Path, request: dict[str, Any]) -> bool:
    """Return whether the same request was trained before, to its end."""
    former = _read_stamp(output)
    return request in (former, former.get(STARTED)) and (output / "run" / "training.json").exists()


def _difference(stamp: dict[str, Any], request: dict[str, Any]) -> str:
    """Return in which way an earlier request, as its stamp holds it, differs from ``request``."""
    former = stamp.get(STARTED, stamp)
    for name, flag in (("preset", "--preset"), ("downscale", "--downscale")):
        if former.get(name) != request.get(name):
            return f"with {flag} {former.get(name)}"
    return "from other data or by another version"


def _interrupted(output: Path, request: dict[str, Any]) -> bool:
    """Return whether a training of the same request was interrupted and can resume."""
    return _read_stamp(output).get(STARTED) == request and (output / "run" / "config.yml").exists()


def train(scene: MadeScene, run: Path, preset: str, downscale: float, photos: str) -> None:
    """Run ns-train in a process of its own, as a user would."""
    words = [
        str(Path(sys.executable).parent / "ns-train"), preset, "--data", str(scene.data),
        "--run-dir", str(run.absolute()), "--vis", "tensorboard", "--pipeline.datamanager.photos", photos,
        *(AGREE if scene.made_masks is not None and photos == "all" else ()), *(() if sys.stdout.isatty() else QUIET),
        "beags-data", "--downscale-factor", str(downscale), *scene.options(),
    ]  # fmt: skip
    CONSOLE.print(f"$ {command(words)}")
    _finish(words)


def resume(run: Path) -> None:
    """Resume an interrupted training in a process of its own."""
    CONSOLE.print(
        f"Resuming the training that was interrupted (add --fresh to start anew).\n$ beags resume {quoted(run)}"
    )
    _finish([sys.executable, "-m", "beags_plugin.commands.cli", "resume", str(run)])


def _finish(words: list[str]) -> None:
    quiet = {**os.environ, "PYTHONWARNINGS": os.environ.get("PYTHONWARNINGS", "ignore::FutureWarning")}
    code = subprocess.run(bound(words), env=quiet).returncode
    if code != 0:
        raise UserError(f"training ended with exit code {code}; what it printed above says why.")


def measure(run: Path, output: Path, seconds: dict[str, float], scene: MadeScene) -> None:
    """Compare assignment alone with refinement, extract every object, write summary.json and the pictures."""
    from beags_plugin.commands.certainty import certainty, write_doubt
    from beags_plugin.evaluation.table import render_run, summary_json
    from beags_plugin.objects.evaluate import EvaluatedRun
    from beags_plugin.objects.extract import extract_objects
    from beags_plugin.pictures.cells import write_picture
    from beags_plugin.pictures.contact_sheet import contact_sheet
    from beags_plugin.pictures.object_cells import Drawing

    with timed(seconds, "evaluation"), progress_bar("Evaluating") as progress:
        evaluated = EvaluatedRun(run / "config.yml")
        metrics = evaluated.metrics(progress=progress)
    with timed(seconds, "extraction"), progress_bar("Extracting") as progress:
        extracted = extract_objects(run / "config.yml", progress=progress)
    picture = output / "contact_sheet.png"
    with timed(seconds, "picture"), progress_bar("Making the picture") as progress:
        views = evaluated.views
        refined, drawing = evaluated.stages["after"], Drawing(evaluated.rasterizer, evaluated.settings)
        sheet = contact_sheet(
            views, views.cameras("train"), refined.surfels(), _alone(evaluated, extracted), evaluated.classes, drawing,
            background=views.background, progress=progress,
        )  # fmt: skip
        write_picture(picture, sheet)
    training = json.loads((run / "training.json").read_text())
    made = {name: seconds.pop(name) for name in ("sample", "poses and masks") if name in seconds}
    stages = {**made, **training["seconds"], **seconds}
    memory = training["peak_memory_mb"]
    sure = certainty(run, scene.data, scene.made_masks)
    summary = {**summary_json(metrics, stages, memory), "certainty": sure.to_json()}
    write_text_atomically(json.dumps(summary, indent=2), output / "summary.json")
    doubt = write_doubt(run, output / "doubt.png")
    CONSOLE.print(render_run(metrics, stages, memory))
    CONSOLE.print(f"objects: {', '.join(str(item.ply) for item in extracted)}")
    CONSOLE.print(f"figures: {output / 'summary.json'}")
    CONSOLE.print(f"picture: {picture}")
    if doubt:
        CONSOLE.print(f"doubt:   {output / 'doubt.png'}")
    CONSOLE.print(f"look:    beags view {quoted(run)}")
    for line in sure.lines:
        CONSOLE.print(line)


def _alone(run: EvaluatedRun, written: Sequence[Extracted]) -> dict[int, dict[str, Surfels]]:
    """Return object id to its Gaussians with assignment alone, and as they were written."""
    from beags_plugin.core.select import select_class
    from beags_plugin.runs.read import read_run

    base = run.stages["before"]
    objects = {each: select_class(base.surfels(), base.members, each)[0] for each in run.classes if each != 0}
    found = {class_id: {"before": surfels} for class_id, surfels in objects.items()}
    for scene in (read_run(each.config) for each in written):
        if len(scene.members):
            found[int(scene.members.class_ids[0])]["after"] = scene.surfels()
    return found


@contextmanager
def timed(seconds: dict[str, float], name: str) -> Iterator[None]:
    """Measure the wall time of the block into ``seconds[name]``."""
    start = time.perf_counter()
    yield
    seconds[name] = time.perf_counter() - start
