"""Masks of objects that were picked in the viewer, for refinement."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from beags_plugin.core.membership import Membership
from beags_plugin.labels.class_ids import BACKGROUND
from beags_plugin.masks.sources.cut import DrawnSource
from beags_plugin.objects.check_masks import options_beside
from beags_plugin.objects.make_masks import make_masks
from beags_plugin.runs.layout import refinable
from beags_plugin.runs.run import Run
from beags_plugin.runs.run_config import RunConfig
from beags_plugin.system.digests import content_digest
from beags_plugin.system.errors import UserError
from beags_plugin.system.pasted import command
from beags_plugin.system.whole_files import write_text_atomically
from beags_plugin.views.data_options import DataOptions

STAMP = "masks_picked.txt"  # file with a digest of the picked masks beside it, which shows if they were edited
FOLDER = "picked"  # folder of the run for masks that must not replace the scene's


@dataclass(frozen=True)
class SavedMasks:
    """Masks that were written: sentences that name the files, and the command that refines with them."""

    said: str
    command: str


def masks_folder(run: Path) -> Path:
    """Return the first of a run's folders ``picked``, ``picked_2``, ... whose masks are not ``masks_changed``."""
    names = [FOLDER, *(f"{FOLDER}_{number}" for number in range(2, 1000))]
    return next((run / name for name in names if not masks_changed(run / name)), run)


def save_masks(run: Run, members: Membership, names: Mapping[int, str], folder: Path | None = None) -> SavedMasks:
    """Write masks of all training views, classes.json and made.png.

    members: of the run's Gaussians. folder: for the masks; ``masks_folder`` if None. Raises ``UserError`` if there is
    no object, if files cannot be written, and for a folder with ``masks_changed``.
    """
    if not any(class_id != BACKGROUND for class_id in members.present()):
        raise UserError("nothing has been picked yet: click on an object first.")
    data = options_beside(run, None)
    scene = Path(data.data).absolute()
    scene = scene if scene.is_dir() else scene.parent
    folder = masks_folder(run.folder) if folder is None else folder.absolute()
    if folder == run.folder or masks_changed(folder):
        raise UserError(f"{folder} holds masks that were not written here, or have been changed: name another folder.")
    again = _holds_masks(folder)
    make_masks(data, DrawnSource(members, names), run, folder, overwrite=again)
    write_text_atomically(_digest(folder), folder / STAMP)
    sentence = f"{'Replaced' if again else 'Saved'} {folder / 'masks'} and classes.json; look at {folder / 'made.png'}."
    own: dict[str, Any] = {"masks_path": None, "classes_path": Path("classes.json"), "ignore_ids": ()}
    if folder != scene:
        own |= {"masks_path": folder / "masks", "classes_path": folder / "classes.json"}
    return SavedMasks(sentence, refinement_command(run.config, replace(data, **own)))


def refinement_command(config: RunConfig, parser: DataOptions) -> str:
    """Return the command that refines a run, or the base of a refined run, with other masks.

    parser: the run's data options, with the masks.
    """
    photos = config.data_config.photos
    words = [
        "ns-train", "beags-refine", "--data", str(parser.data),
        "--load-dir", str(refinable(config.get_checkpoint_dir().absolute())),
        *([] if photos == "all" else ["--pipeline.datamanager.photos", photos]), *option_words(parser),
    ]  # fmt: skip
    return command(words)


def option_words(parser: DataOptions) -> list[str]:
    """Return the options of ``beags-data`` that differ from the defaults, as words of a command.

    Options that the command line does not offer are left out.
    """
    usual, words = DataOptions(), []
    for field in fields(parser):
        value = getattr(parser, field.name)
        hidden = str(field.type).startswith("Suppress") or field.name in ("_target", "data")
        if not hidden and value != getattr(usual, field.name):
            parts = [str(each) for each in value] if isinstance(value, (list, tuple)) else [str(value)]
            words += [f"--{field.name.replace('_', '-')}", *parts]
    return ["beags-data", *words] if words else []


def masks_changed(folder: Path) -> bool:
    """Return whether a folder has masks that were not written by ``save_masks``, or have been changed since."""
    stamp = folder / STAMP
    return _holds_masks(folder) and not (stamp.exists() and stamp.read_text() == _digest(folder))


def _holds_masks(folder: Path) -> bool:
    return any((folder / "masks").rglob("*.png")) or (folder / "classes.json").exists()


def _digest(folder: Path) -> str:
    files = sorted((folder / "masks").rglob("*.png"))
    return content_digest([folder / "classes.json", *files] if (folder / "classes.json").exists() else files)
