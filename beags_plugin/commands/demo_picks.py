"""``beags demo --pick``: the base trains, objects are picked on it in the viewer, and training goes on with masks."""

from __future__ import annotations

import io
import json
import shutil
import subprocess
import sys
from collections.abc import Sequence
from contextlib import redirect_stdout
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from beags_plugin.commands.answers import CONSOLE, read_object
from beags_plugin.commands.demo_training import (
    STARTED,
    difference,
    quiet_environment,
    read_stamp,
    train_once,
    trained,
    write_stamp,
)
from beags_plugin.commands.made_masks import MADE
from beags_plugin.commands.scene_setup import MadeScene, object_name
from beags_plugin.data.files import OWN_PICTURES
from beags_plugin.system.child_processes import bound
from beags_plugin.system.digests import folder_digest, value_digest
from beags_plugin.system.errors import UserError
from beags_plugin.system.whole_files import write_text_atomically

if TYPE_CHECKING:
    from beags_plugin.plugin.views.datamanager import BeagsDataManagerConfig

APART = "apart"  # Folder in the output: masks/, classes.json, report.json and doubt.png of separated things.
APART_STAMP = "apart.json"  # This file in APART holds digests of the inputs of the masks, and of the masks as made.
FOLDER = "pick"  # Folder in the output: run/ is the base; masks/ and classes.json hold the picked objects.
OF_MASKS = ("masks", "classes.json", MADE, *OWN_PICTURES)  # They choose a base's close-ups alone.


def names_of(data: Path, objects: int) -> tuple[str, ...]:
    """Return the names of so many objects until the user names them."""
    name = object_name(data)
    return (name,) if objects == 1 else tuple(f"{name} {number}" for number in range(1, objects + 1))


def check_trained_otherwise(output: Path, fresh: bool, how: dict[str, Any]) -> None:
    """Raise ``UserError``, before anything is trained, if the run there was trained otherwise than ``how``."""
    run, stamp = output / "run", read_stamp(output)
    former = stamp.get(STARTED, stamp)
    if not fresh and (run / "training.json").exists() and {name: former.get(name) for name in how} != how:
        raise UserError(
            f"{run} holds a run that was trained {difference(stamp, {**former, **how})}: add --fresh to replace it "
            "(its base is used again), or choose another --output."
        )


def check_one_object(scene: MadeScene, data: Path) -> None:
    """Raise ``UserError`` unless a network made the masks, of one object, which can be split into things."""
    folder = scene.labels or scene.data
    names = json.loads((folder / "classes.json").read_text()) if (folder / MADE).exists() else {}
    if len(set(names) - {"0"}) != 1:
        raise UserError(
            f"the masks of {data} are not a network's that marks one object, so there are no things to tell apart in "
            "it: leave --objects out, or add --pick."
        )


def trained_base(
    scene: MadeScene, output: Path, request: dict[str, Any], without_picks: dict[str, Any], fresh: bool
) -> Path:
    """Return the run of a scene's base, which is trained unless that was done before.

    request: preset and size. without_picks: the request of a demo without picks, which has the same base. fresh:
    replace a base that was trained otherwise. Raises ``UserError`` as ``train_once`` does.
    """
    folder = output / FOLDER
    request = {**request, "inputs": value_digest([_base_digest(scene, output), "base"])}
    if not trained(folder, request) and trained(output, without_picks):
        _copy_base(output / "run", folder, request)
    if trained(folder, request):
        CONSOLE.print(f"The base was trained before: {folder / 'run'}.")
    else:
        train_once(scene, folder, request, fresh, words=("--pipeline.model.refine-steps", "0"))
    return folder / "run"


def picked_scene(scene: MadeScene, base: Path, names: Sequence[str], fresh: bool, again: str) -> MadeScene:
    """Return the scene with masks of the objects picked on its base; the viewer opens unless that was done before.

    names: of the expected objects. again: the command that continues. Raises ``UserError`` if nothing is saved.
    """
    from beags_plugin.objects.picked_masks import STAMP, masks_changed

    folder = base.parent
    exist = any((folder / "masks").rglob("*.png"))
    if exist and masks_changed(folder):
        CONSOLE.print(f"The masks in {folder / 'masks'} were mended, so they stay: delete them for new ones.")
    elif exist and not fresh:
        CONSOLE.print(f"Picked before: {folder / 'made.png'} (add --fresh to pick again).")
    else:
        before = _changed_at(folder / STAMP)
        _open_viewer(base, folder, names, again)
        if _changed_at(folder / STAMP) == before:
            raise UserError(f"nothing was saved in the viewer, so there is no object yet. {_go_on(again)}")
    return replace(scene, labels=folder)


def things_apart(scene: MadeScene, output: Path, base: Path, objects: int) -> MadeScene:
    """Return the scene with masks of at most so many things that lie apart in the base.

    Masks made before of the same masks and base are used again, and masks that the user mended are kept.
    """
    from beags_plugin.objects.agree_masks import agree_masks
    from beags_plugin.objects.reproject_masks import ReprojectionOptions
    from beags_plugin.runs.run import Run

    folder, given = output / APART, scene.labels or scene.data
    masks, stamp = folder / "masks", folder / APART_STAMP
    made_of = value_digest([folder_digest(given / "masks"), _changed_at(base / "training.json"), objects])
    former, exist = read_object(stamp), any(masks.rglob("*.png"))
    if former.get("of") == made_of and exist:
        CONSOLE.print(f"Separated before: {masks}.")
    elif exist and stamp.exists() and former.get("masks") != folder_digest(masks):
        # The user may have mended masks beside a damaged stamp.
        CONSOLE.print(f"The masks in {masks} were mended, so they stay: delete {folder} for new ones.")
    else:
        shutil.rmtree(folder, ignore_errors=True)
        options = ReprojectionOptions(given / "masks", given / "classes.json", run_size=True)
        for line in agree_masks(Run(base / "config.yml"), options, folder, objects, enlarge=True):
            CONSOLE.print(line)
        write_text_atomically(json.dumps({"of": made_of, "masks": folder_digest(masks)}), stamp)
    return replace(scene, labels=folder)


def close_ups_help(scene: MadeScene, base: Path, request: dict[str, Any], same: bool) -> bool:
    """Return whether a training from the beginning with the scene's masks sees close-ups that the base did not see.

    base: its run. request: preset and size. same: whether masks that the base may have had show the same objects.
    """
    from beags_plugin.plugin.presets import load_preset
    from beags_plugin.runs.checkpoint_file import read_checkpoint, saw_close_ups
    from beags_plugin.runs.layout import newest_checkpoint
    from beags_plugin.views.data_options import DataOptions, RunViewOptions
    from beags_plugin.views.focus import sees_close_ups
    from beags_plugin.views.run_data import RunData

    masks, classes = scene.mask_paths()
    options = DataOptions(scene.data, masks_path=masks, downscale_factor=request["downscale"])
    options.classes_path = classes if classes.exists() else options.classes_path
    focus = cast("BeagsDataManagerConfig", load_preset(request["preset"]).config.pipeline.datamanager).focus
    with redirect_stdout(io.StringIO()):  # Training prints the same about the data.
        files = RunData(RunViewOptions(dataparser=options), "val").files["train"]
        seen = sees_close_ups(focus, files)
    return seen and not (same and saw_close_ups(read_checkpoint(newest_checkpoint(base / "nerfstudio_models"))))


def _open_viewer(base: Path, folder: Path, names: Sequence[str], again: str) -> None:
    what = names[0] if len(names) == 1 else f"{len(names)} objects"
    CONSOLE.print(f"Now pick {what} in the viewer; the demo goes on by itself once the masks are saved.")
    words = [sys.executable, "-m", "beags_plugin.commands.cli", "view", str(base), "--save-to", str(folder), "--expect"]
    try:
        code = subprocess.run(bound([*words, *names]), env=quiet_environment()).returncode
    except KeyboardInterrupt:
        CONSOLE.print(f"\nNothing was saved in the viewer. {_go_on(again)}")
        raise
    if code:
        raise UserError(f"the viewer ended with exit code {code}; what it printed above says why. {_go_on(again)}")


def _go_on(again: str) -> str:
    return f"The base stays; go on with:\n    {again}"


def _copy_base(run: Path, folder: Path, request: dict[str, Any]) -> None:
    """Copy the base of a demo without picks."""
    unfinished = folder / "run.unfinished"
    shutil.rmtree(unfinished, ignore_errors=True)
    shutil.copytree(run / "base", unfinished)
    shutil.copyfile(run / "training.json", unfinished / "training.json")
    shutil.rmtree(folder / "run", ignore_errors=True)
    write_stamp(folder, request)
    unfinished.rename(folder / "run")
    CONSOLE.print(f"The base of {run} is used again: {folder / 'run'}.")


def _base_digest(scene: MadeScene, output: Path) -> str:
    inside = scene.data.resolve().is_relative_to(output.resolve())
    return folder_digest(scene.data, without=None if inside else output, names=OF_MASKS)


def _changed_at(path: Path) -> int | None:
    return path.stat().st_mtime_ns if path.exists() else None
