"""Runs on disk: a folder with config.yml and a checkpoint, on which every ns-* command works."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from beags_plugin.system.digests import content_digest
from beags_plugin.system.errors import UserError
from beags_plugin.system.reading.text import load_json, reason

if TYPE_CHECKING:
    pass


BASE_SNAPSHOT = "base"  # folder of the run that keeps the scene as it was when refinement started
PREPARED = "prepared"  # folder of the run that keeps masks, grids and what was found
EXTRACTION_FILE = "extraction.json"  # in a run that holds a part of another: of which, and what was taken
REPORT_FILE = "training.json"  # seconds and memory of a run that is complete
TRANSFORM_FILE = "dataparser_transforms.json"  # nerfstudio's name for how the poses were normalised


def newest_checkpoint(folder: Path) -> Path:
    """The checkpoint of the highest step in ``folder`` (a nerfstudio_models folder); raises ``UserError`` if none."""
    checkpoints = sorted(folder.glob("step-*.ckpt")) if folder.is_dir() else []
    if not checkpoints:
        raise UserError(f"{folder} holds no checkpoint (step-….ckpt): train longer, or name another run.")
    return checkpoints[-1]


def round_folder(run: Path, index: int) -> Path:
    """Where a run keeps what the refinement round of this index was prepared with."""
    return run / PREPARED if index == 0 else run / PREPARED / f"round_{index + 1}"


def preparing_run(run: Path) -> Path:
    """The run that prepared refinement for what ``run`` holds: itself, or the one it is the base or an extract of."""
    origin = run / EXTRACTION_FILE
    if origin.exists():
        return preparing_run(Path(_origin(origin, "run", str, "")).parent)
    return run.parent if run.name == BASE_SNAPSHOT and (run.parent / PREPARED).is_dir() else run


def prepared_digests(run: Path) -> list[str] | None:
    """Of each round that refinement was prepared for, for what ``run`` holds, a digest of its masks and grid.

    Of an extract they are those of the time when it was made; None for one that has not kept them.
    """
    origin = run / EXTRACTION_FILE
    if origin.exists():
        return _origin(origin, "prepared", list, None)
    digests = []
    while (digest := round_digest(round_folder(preparing_run(run), len(digests)))) is not None:
        digests.append(digest)
    return digests


def _origin(path: Path, name: str, kind: type, absent: Any) -> Any:
    """An entry of an extract's file; ``UserError`` if the file is damaged."""
    try:
        found = load_json(path).get(name, absent)
    except (OSError, ValueError, AttributeError) as error:
        raise UserError(f"{path} cannot be read ({reason(error)}): extract the object again.") from error
    if found is not absent and not isinstance(found, kind) or found == "":
        raise UserError(f"{path} has no usable {name!r}: extract the object again.")
    return found


def round_digest(folder: Path) -> str | None:
    """Of the masks and the grid that lie in the folder of a round; None if none was prepared there."""
    if not (folder / "grid.pt").exists():
        return None
    return content_digest([folder / "grid.pt", *sorted((folder / "masks").glob("*.png"))])


def last_prepared(run: Path) -> Path:
    """What the last round of a run was prepared with, whether or not anything was."""
    index = 0
    while (round_folder(run, index + 1) / "grid.pt").exists():
        index += 1
    return round_folder(run, index)
