"""Masks of objects that were picked in the viewer, so that refinement makes them clean."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from beags_plugin.core.membership import Membership
from beags_plugin.labels.class_ids import BACKGROUND
from beags_plugin.picking.source import DrawnSource
from beags_plugin.plugin.objects.check_masks import options_beside
from beags_plugin.plugin.objects.make_masks import make_masks
from beags_plugin.plugin.runs.place import open_run
from beags_plugin.system.digests import content_digest
from beags_plugin.system.errors import UserError
from beags_plugin.system.pasted import command, quoted
from beags_plugin.system.whole_files import write_text_atomically

STAMP = "masks_picked.txt"  # beside masks that were picked: a digest of them, which shows whether they were mended
FOLDER = "picked"  # in the run, for masks that must not replace the scene's


def save_masks(config_path: Path, members: Membership, names: Mapping[int, str]) -> list[str]:
    """Write masks of all training views and classes.json; return sentences on where, and on how to refine with them.

    They go to the scene's folder, where ``beags-data`` looks for them; but if that has masks or class names which were
    not written here, or have been changed since, to ``picked/`` of the run, or ``picked_2/``, ... Nothing but unchanged
    masks of an earlier call is replaced. config_path: of the run. members: of its Gaussians. Raises ``UserError`` if
    there is no object, or where files cannot be written.
    """
    if not any(class_id != BACKGROUND for class_id in members.present()):
        raise UserError("nothing has been picked yet: click on an object first.")
    run, data = config_path.parent, options_beside(config_path, None)
    scene = Path(data.data).absolute()
    scene = scene if scene.is_dir() else scene.parent
    places = [scene, *(run / (FOLDER if number == 1 else f"{FOLDER}_{number}") for number in range(1, 1000))]
    folder = next((place for place in places if _free(place)), None)
    if folder is None:
        raise UserError(f"{run} has too many folders of masks: delete some of {FOLDER}_….")
    again = _holds_masks(folder)
    make_masks(data, DrawnSource(members, names), config_path, folder, overwrite=again)
    write_text_atomically(_digest(folder), folder / STAMP)
    config = open_run(config_path)
    saved = f"{'Replaced' if again else 'Saved'} {folder / 'masks'} and classes.json; look at {folder / 'made.png'}."
    refine = command(["ns-train", "beags-refine", "--data", data.data, "--load-dir", config.get_checkpoint_dir()])
    if folder == scene:
        return [saved, f"Next: {refine}"]
    kept = f"{scene} has masks already, which stay as they are."
    return [saved, kept, f"Next: {refine} beags-data --masks-path {quoted(folder / 'masks')} --classes-path "
            f"{quoted(folder / 'classes.json')}"]  # fmt: skip


def _holds_masks(folder: Path) -> bool:
    return any((folder / "masks").rglob("*.png")) or (folder / "classes.json").exists()


def _free(folder: Path) -> bool:
    """Return whether a folder has no masks, or those that were written here, as they were."""
    if not _holds_masks(folder):
        return True
    stamp = folder / STAMP
    return stamp.exists() and stamp.read_text() == _digest(folder)


def _digest(folder: Path) -> str:
    files = sorted((folder / "masks").rglob("*.png"))
    return content_digest([folder / "classes.json", *files] if (folder / "classes.json").exists() else files)
