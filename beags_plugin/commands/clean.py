"""``beags clean``: refine a scene that another program trained, and write it back in its own format."""

from __future__ import annotations

import json
import re
import shutil
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from beags_plugin.commands.answers import CONSOLE
from beags_plugin.system.errors import UserError, check_choice
from beags_plugin.system.pasted import command
from beags_plugin.system.progress import progress_bar
from beags_plugin.system.whole_files import write_text_atomically

if TYPE_CHECKING:
    from beags_plugin.commands.scene_setup import MadeScene
    from beags_plugin.evaluation.report import RunMetrics

REPORT, STAMP = "clean.json", "cleaning"  # STAMP lies beside a run that this command made.


def clean_scene(
    path: Path,
    data: Path,
    objects: Sequence[str],
    output: Path | None,
    polish: int,
    steps: int | None,
    overwrite: bool = False,
) -> None:
    """Refine the scene in ``path`` with the photos and masks in ``data``; write files and a report to ``output``.

    objects: names of the objects that also get files of their own. polish: base steps before refinement, for a scene of
    3D Gaussians. steps: of refinement, the preset's if None. overwrite: replace a scene that was cleaned there before.
    Raises ``UserError``.
    """
    from beags_plugin.commands.scene_setup import made_scene
    from beags_plugin.importers.base import read_scene
    from beags_plugin.objects.evaluate import EvaluatedRun
    from beags_plugin.objects.written_back import changes, format_of, write_back

    if polish < 0 or (steps is not None and steps < 1):
        raise UserError("--polish is 0 or more, and --steps 1 or more.")
    imported = read_scene(path)
    written, output = format_of(path, imported), output or Path("outputs") / f"{path.stem}_cleaned"
    volume = imported.gaussians.log_scales.shape[1] == 3
    del imported
    run = output / "run"
    if run.exists() and not (output / STAMP).exists():
        raise UserError(f"{run} is not of beags clean: choose another --output, or move it away.")
    if (output / REPORT).exists() and not overwrite:
        raise UserError(f"{output} holds a cleaned scene: add --overwrite to replace it, or choose another --output.")
    scene = made_scene(data, output)
    check_names(scene, objects)
    shutil.rmtree(run, ignore_errors=True)
    write_text_atomically(str(path.absolute()), output / STAMP)
    _train(path, scene, run, polish if volume else 0, steps)
    config = run / "config.yml"
    evaluated = EvaluatedRun(config)
    with progress_bar("Evaluating") as progress:
        metrics = evaluated.metrics(progress=progress)
    before, after = evaluated.stages["before"].surfels(), evaluated.stages["after"].surfels()
    files = write_back(config, written, output, path.stem, objects)
    report = {
        "scene": str(path.absolute()),
        "files": [str(file) for file in files],
        "start": json.loads((run / "start.json").read_text()),
        "polish": polish if volume else 0,
        "changes": asdict(changed := changes(before, after)),
        "metrics": metrics.to_json(),
    }
    write_text_atomically(json.dumps(report, indent=1, allow_nan=False), output / REPORT)
    for line in [
        *figures(report["start"], metrics),
        str(changed),
        *filter(None, [written.note]),
        *turned(report["start"]),
    ]:
        CONSOLE.print(line)
    CONSOLE.print(f"scene:   {files[0]}")
    for file in files[1:]:
        CONSOLE.print(f"object:  {file}")
    CONSOLE.print(f"figures: {output / REPORT}")


def check_names(scene: MadeScene, objects: Sequence[str]) -> None:
    """Raise ``UserError`` for a name that no class has, before anything is trained."""
    from beags_plugin.labels.classes import read_classes

    classes = (scene.labels or scene.data) / "classes.json"
    names = read_classes(classes) if classes.exists() else {}
    for name in objects:
        if names:
            check_choice(name, [each for class_id, each in names.items() if class_id], "object")
        elif not re.fullmatch(r"class_[1-9]\d*", name):
            raise UserError(f"there is no object {name!r}: {classes} does not exist, so they are class_1 and so on.")


def _train(path: Path, scene: MadeScene, run: Path, polish: int, steps: int | None) -> None:
    """Refine in a process of its own, as a user would."""
    from beags_plugin.commands.demo_training import finish

    words = [
        str(Path(sys.executable).parent / "ns-train"), "beags-refine", "--data", str(scene.data),
        "--run-dir", str(run.absolute()), "--vis", "tensorboard", "--pipeline.model.start-from", str(path),
        "--pipeline.model.base-steps", str(polish),
        *([] if steps is None else ["--pipeline.model.refine-steps", str(steps)]),
        "beags-data", *scene.options(),
    ]  # fmt: skip
    CONSOLE.print(f"$ {command(words)}")
    finish(words)


def figures(start: dict[str, Any], metrics: RunMetrics) -> list[str]:
    """Return the lines on quality."""
    lost = start["flattening"]
    shape = "discs already" if lost is None else f"flattened: thinnest scale {lost['median_ratio']:.3f} of the second"
    held_out = start.get("held_out")
    others = f", {held_out['psnr']:.2f} dB in {held_out['views']} held-out views" if held_out else ""
    lines = [f"as it came ({shape}): {start['psnr']:.2f} dB in {start['views']} training views{others}"]
    stages = (metrics.before, "before refinement, held-out views"), (metrics.after, "after it")
    for scores, words in stages:
        if scores is None:
            continue
        facts = [] if scores.psnr is None else [f"{scores.psnr:.2f} dB"]
        extracted = scores.mean.extracted
        if extracted is not None:
            names = (("IoU", extracted.iou), ("spill", extracted.spill))
            facts += [f"{name} {100 * value:.1f} %" for name, value in names if value is not None]
        lines.append(f"{words}: {', '.join(facts) or 'no view to score'}")
    return lines


def turned(start: dict[str, Any]) -> list[str]:
    """Return a sentence if the file's axes were not those of its format."""
    words = start.get("turned")
    return [f"The scene fitted the poses only after {words}; the files are in the poses' world."] if words else []
