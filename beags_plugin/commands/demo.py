"""``beags demo``: sample, training, extraction, measurement, one table and one picture."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from beags_plugin.commands.answers import CONSOLE
from beags_plugin.commands.demo_again import Again
from beags_plugin.commands.demo_picks import (
    APART,
    check_one_object,
    check_trained_otherwise,
    close_ups_help,
    names_of,
    picked_scene,
    things_apart,
    trained_base,
)
from beags_plugin.commands.demo_training import STARTED, WITHOUT, read_stamp, train_once
from beags_plugin.system.digests import code_digest, value_digest
from beags_plugin.system.errors import UserError, check_choice
from beags_plugin.system.pasted import quoted
from beags_plugin.system.progress import progress_bar, timed
from beags_plugin.system.whole_files import write_text_atomically
from beags_plugin.system.wording import amount

if TYPE_CHECKING:
    from beags_plugin.commands.certainty import Certainty
    from beags_plugin.commands.scene_setup import MadeScene
    from beags_plugin.core.surfels import Surfels
    from beags_plugin.objects.evaluate import EvaluatedRun
    from beags_plugin.objects.extract import Extracted
    from beags_plugin.plugin.options.model_options import BeagsModelConfig

BEFORE = ("sample", "poses", "poses and masks", "base training")  # Stages before the training that is measured.
EXCHANGED = ("inverted", "swapped ids")  # Kinds of issues with whole masks that contradict the others.
PRESET, PRESET_OF_PHOTOS = "beags-tiny", "beags-fast"
SIZE, DOWNSCALE = (640, 480), 2.5
"""Width and height of the generated photos, and their downscale factor in training."""
GENERATED = ("--pipeline.datamanager.dense-seeds", "off")
"""Options of training on the generated photos."""


def run_demo(
    data: Path | None, output: Path | None, preset: str | None, downscale: float | None, seed: int, fresh: bool,
    strict: bool = False, pick: bool = False, objects: int = 1, mask_source: str | None = None,
    mask_options: tuple[str, ...] = (),
) -> None:  # fmt: skip
    """Run the whole demo in ``output`` and print the table; see ``cli.Demo`` for the arguments."""
    from beags_plugin.commands.made_masks import SALIENT, ChosenSource
    from beags_plugin.commands.scene_setup import MadeScene, made_scene, name_of
    from beags_plugin.data.layout import read_dataset
    from beags_plugin.sample.writer import SampleConfig, make_sample
    from beags_plugin.views.quick import quick_downscale

    again = Again(data, output, preset, downscale, objects, pick, mask_source, mask_options, seed)
    preset = preset or (PRESET if data is None else PRESET_OF_PHOTOS)
    check_preset(preset)
    if downscale is not None and not 1.0 <= downscale < math.inf:
        raise UserError(f"downscale is {downscale}: give 1 (full size) or more.")
    _check_objects(data, pick, objects, strict)
    chosen = ChosenSource(mask_source or SALIENT.name, mask_options)
    if chosen != SALIENT and (pick or data is None):
        raise UserError("no masks are made with --pick or of the sample, which has some: leave --mask-source out.")
    seconds: dict[str, float] = {}
    if data is None:
        output = output or Path("outputs/demo")
        scene = MadeScene(output / "sample")
        with timed(seconds, "sample"):
            make_sample(scene.data, SampleConfig(seed, *SIZE, 30, 6, num_points=6000, family="desk"))
        downscale = downscale or DOWNSCALE
    else:
        output = output or Path("outputs") / name_of(data)
        if output.resolve() == data.resolve():
            raise UserError(f"{output} is the data: give another --output.")
        how = {"pick": True} if pick else {"objects": objects} if objects > 1 else {}
        check_trained_otherwise(output, fresh, how)
        with timed(seconds, "poses" if pick else "poses and masks"):
            scene = made_scene(data, output, not pick, chosen.below(output / "scene").below(data))
        if objects > 1 and not pick:
            check_one_object(scene, data)
        if strict:
            check_contradictions(scene, output)
        read_dataset(scene.data)  # It reports what is missing before a training starts.
        downscale = downscale or quick_downscale(scene.data)
    request = {"preset": preset, "downscale": downscale}
    if pick:
        assert data is not None
        names = names_of(data, objects)
        scene = _trained_on_base(
            scene, output, request, fresh, seconds, {"pick": True},
            lambda base: picked_scene(scene, base, names, fresh, again.picking()),
        )  # fmt: skip
    elif objects > 1 and not scene.turned:
        scene = _trained_on_base(
            scene, output, request, fresh, seconds, {"objects": objects},
            lambda base: things_apart(scene, output, base, objects),
        )  # fmt: skip
    else:
        if objects > 1:
            CONSOLE.print("As they turned before a room that stands, the things stay one object.")
        scene = _trained_by_masks(scene, output, request, fresh, GENERATED if data is None else ())
    sure = measure(output / "run", output, seconds, scene, again)
    if pick:
        CONSOLE.print(
            f"If the objects are not what you meant, pick them again on the same base:\n    {again.picking()} --fresh"
        )
    if strict and sure.level == "not sure":
        raise UserError(
            f"the masks contradict each other too much (see above); the result is in {output} all the same. Do what "
            "the lines above say, or leave --strict out."
        )


def _trained_by_masks(
    scene: MadeScene, output: Path, request: dict[str, Any], fresh: bool, words: Sequence[str]
) -> MadeScene:
    """Train a scene with its masks; words: further options of the training.

    If masks show that a few photos have wrong poses, it is trained again without these; returns the scene that is
    trained in the end.
    """
    from beags_plugin.commands.demo_training import misplaced, without_photos
    from beags_plugin.runs.prepared import photos_contradict

    request = {**request, "inputs": inputs_digest(scene, output, request["preset"])}
    alone = {**request, "photos": "objects"}
    if scene.turned or (alone in (former := read_stamp(output), former.get(STARTED)) and not fresh):
        request = alone
    elif not fresh and (left_out := without_photos(output, request)):
        scene, request = replace(scene, without=left_out), {**request, WITHOUT: list(left_out)}
    train_once(scene, output, request, fresh, words=words)
    if request == alone or scene.without:
        return scene
    if photos_contradict(output / "run"):
        CONSOLE.print(
            "The photos contradict each other outside the masks, as on a turntable: now with the objects' pixels alone."
        )
        train_once(scene, output, alone, fresh, replace=True, words=words)
    elif left_out := misplaced(output / "run"):
        seem = amount(len(left_out), "photo", "seem")
        CONSOLE.print(f"{seem} to have a wrong pose ({', '.join(left_out)}): now without them.")
        scene, request = replace(scene, without=left_out), {**request, WITHOUT: list(left_out)}
        train_once(scene, output, request, fresh, replace=True, words=words)
    return scene


def _trained_on_base(
    scene: MadeScene, output: Path, request: dict[str, Any], fresh: bool, seconds: dict[str, float],
    how: dict[str, Any], with_masks: Callable[[Path], MadeScene],
) -> MadeScene:  # fmt: skip
    """Train the base of a scene, and refine it with masks made on it; return the scene with these masks.

    If the base saw no close-ups of the objects, and these masks show that they help, the whole scene is trained again
    instead. how: entries of the request by which the run differs from one without such masks. with_masks: takes the
    folder of the base's run, and returns the scene with masks.
    """
    from beags_plugin.runs.prepared import photos_contradict

    made = output / "made"  # A demo without picks trains with the masks that it has made here.
    inputs = inputs_digest(replace(scene, labels=made if made.exists() else None), output, request["preset"])
    base = trained_base(replace(scene, labels=None), output, request, {**request, "inputs": inputs}, fresh)
    seconds["base training"] = _base_seconds(base)
    scene = with_masks(base)
    request = {**request, "inputs": inputs_digest(scene, output, request["preset"]), **how}
    words = ("--load-dir", str((base / "nerfstudio_models").absolute()), "--pipeline.model.base-steps", "0")
    begins = fresh or request not in (former := read_stamp(output), former.get(STARTED))
    if begins and close_ups_help(scene, base, request, same="objects" in how):
        CONSOLE.print("Training starts again, now with close-ups of the objects, so that they come out sharper.")
        words = ()
    train_once(scene, output, request, fresh, words=words)
    seconds["base training"] += _base_seconds(output / "run")
    if photos_contradict(output / "run"):
        CONSOLE.print(
            "The photos contradict each other outside the masks, as on a turntable: without --pick and --objects, "
            "poses and training use the objects' pixels alone."
        )
    return scene


def _base_seconds(run: Path) -> float:
    return json.loads((run / "training.json").read_text())["seconds"].get("base training", 0.0)


def _check_objects(data: Path | None, pick: bool, objects: int, strict: bool) -> None:
    """Raise ``UserError`` for options that do not go together."""
    if objects < 1:
        raise UserError(f"objects is {objects}: give 1 or more.")
    if pick and data is None:
        raise UserError("there is nothing to pick, as the sample has masks: name photos with --data.")
    if pick and strict:
        raise UserError("with --pick there are no masks of a network that could contradict: leave --strict out.")
    if objects > 1 and data is None:
        raise UserError("the sample has masks of its objects: name photos with --data, or leave --objects out.")


def check_contradictions(scene: MadeScene, output: Path) -> None:
    """Raise ``UserError`` where masks contradict the other views at shared points (``beags masks check``).

    output: folder of the demo; it gets contradicted.png.
    """
    from beags_plugin.objects.check_masks import check_scene, options_beside, write_contradictions

    masks = None if scene.labels is None else (scene.labels / "masks").absolute()
    report = check_scene(options_beside(None, scene.data, masks_path=masks))
    views = [one.view for one in report.contradictions]
    views += [view for issue in report.issues if issue.kind in EXCHANGED for view in issue.views]
    views = list(dict.fromkeys(views))
    if views:
        written = write_contradictions(report, output)
        see = f"; see {written[0]}" if written else ""
        named = ", ".join(views[:6]) + (f" and {len(views) - 6} more" if len(views) > 6 else "")
        contradict = amount(len(views), "mask", "contradict")
        raise UserError(f"{contradict} the others ({named}{see}): correct or delete them, or leave --strict out.")
    if not report.tracked:
        CONSOLE.print(
            "Without points of COLMAP's, only inverted and exchanged masks are found before training; the others "
            "decide at the end how sure the result is."
        )


def check_preset(preset: str) -> None:
    """Raise ``UserError`` unless the preset trains a base and refines it, because the demo compares the two."""
    from beags_plugin.plugin.presets import load_preset, preset_names

    check_choice(preset, preset_names(), "preset")
    model = cast("BeagsModelConfig", load_preset(preset).config.pipeline.model)
    if not (model.base_steps and model.refine_steps):
        raise UserError(f"the demo compares a base with its refinement, and {preset} trains only one: take beags-tiny.")


def inputs_digest(scene: MadeScene, output: Path, preset: str) -> str:
    """Return a digest of the preset, the package's code and the files of the data (by name, size and time)."""
    from beags_plugin.plugin.presets import preset_files

    texts = [path.read_text("utf8") for path in preset_files(preset)]
    return value_digest([*scene.digests(output), code_digest(), *texts])


def measure(run: Path, output: Path, seconds: dict[str, float], scene: MadeScene, again: Again) -> Certainty:
    """Compare assignment alone with refinement, extract every object, write summary.json and the pictures.

    Returns how sure the result is, which it also prints.

    again: the demo's command.
    """
    from beags_plugin.commands.certainty import certainty, write_doubt
    from beags_plugin.commands.photo_coverage import coverage
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
        objects = _alone(evaluated, extracted)
        sheet = contact_sheet(
            views, views.cameras("train"), refined.surfels(), objects, evaluated.classes, drawing,
            background=views.background, progress=progress,
        )  # fmt: skip
        write_picture(picture, sheet)
    training = json.loads((run / "training.json").read_text())
    made = {name: seconds.pop(name) for name in BEFORE if name in seconds}
    stages = {**made, **{name: taken for name, taken in training["seconds"].items() if name not in made}, **seconds}
    memory = training["peak_memory_mb"]
    apart = scene.labels if scene.labels == output / APART else None
    sure = certainty(run, scene, again, apart, coverage(evaluated, objects))
    judged = {"level": sure.level, "sentences": sure.lines, **sure.figures}
    summary = {**summary_json(metrics, stages, memory), "certainty": judged}
    write_text_atomically(json.dumps(summary, indent=2), output / "summary.json")
    doubt = write_doubt(run, output / "doubt.png", apart)
    CONSOLE.print(render_run(metrics, stages, memory))
    CONSOLE.print(f"objects: {', '.join(str(item.ply) for item in extracted)}")
    CONSOLE.print(f"figures: {output / 'summary.json'}")
    CONSOLE.print(f"picture: {picture}")
    if doubt:
        CONSOLE.print(f"doubt:   {output / 'doubt.png'}")
    CONSOLE.print(f"look:    beags view {quoted(run)}")
    for line in sure.lines:
        CONSOLE.print(line)
    return sure


def _alone(run: EvaluatedRun, written: Sequence[Extracted]) -> dict[int, dict[str, Surfels]]:
    """Return object id to its Gaussians with assignment alone, and as they were written."""
    from beags_plugin.core.select import select_class
    from beags_plugin.runs.read import read_run

    base = run.stages["before"]
    objects = {each: select_class(base.surfels(), base.members, each)[0] for each in run.classes if each != 0}
    stages = {class_id: {"before": surfels} for class_id, surfels in objects.items()}
    for scene in (read_run(each.config) for each in written):
        if len(scene.members):
            stages[int(scene.members.class_ids[0])]["after"] = scene.surfels()
    return stages
