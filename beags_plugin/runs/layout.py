"""Runs on disk: a folder with config.yml and a checkpoint, on which every ns-* command works."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from beags_plugin.system.digests import content_digest
from beags_plugin.system.errors import UserError
from beags_plugin.system.reading.text import load_json, reason

BASE_SNAPSHOT = "base"  # folder with the scene as refinement started from it
PREPARED = "prepared"  # folder with the masks and grids of refinement
EXTRACTION_FILE = "extraction.json"  # in a run that holds a part of another: which one, and which part
REPORT_FILE = "training.json"  # seconds, memory and a refiner's own figures of a run that is complete
TRANSFORM_FILE = "dataparser_transforms.json"  # nerfstudio's name for the normalisation of the poses


def newest_checkpoint(folder: Path) -> Path:
    """Return the checkpoint of the highest step in a nerfstudio_models folder; raises ``UserError`` if none."""
    checkpoints = sorted(folder.glob("step-*.ckpt")) if folder.is_dir() else []
    if not checkpoints:
        raise UserError(
            f"{folder} holds no checkpoint (step-….ckpt): train longer, copy the whole run, or name another."
        )
    return checkpoints[-1]


def refinable(models: Path) -> Path:
    """Return the nerfstudio_models folder that refinement begins at: that of a run's base, if the run keeps one.

    models: the run's own; a refined scene is not refined again.
    """
    base = models.parent / BASE_SNAPSHOT / models.name
    return base if any(base.glob("step-*.ckpt")) else models


def preparing_run(run: Path) -> Path:
    """Return the run that prepared ``run``: itself, or the one that it is the base or an extract of."""
    origin = run / EXTRACTION_FILE
    if origin.exists():
        recorded = Path(_origin(origin, "run", str, "")).parent
        if run.parent.name == "extracted" and (run.parent.parent / "config.yml").exists():
            recorded = run.parent.parent  # in the usual place; both may have been moved
        return preparing_run(recorded)
    return run.parent if run.name == BASE_SNAPSHOT and (run.parent / PREPARED).is_dir() else run


def digest_of_prepared(run: Path) -> str | None:
    """Return a digest of the masks and the grid that refinement of ``run`` was prepared with, if it was.

    Of an extract it is that at the time of the extraction; None if its file has none.
    """
    origin = run / EXTRACTION_FILE
    return _origin(origin, "prepared", str, None) if origin.exists() else files_digest(preparing_run(run) / PREPARED)


def _origin(path: Path, name: str, kind: type, absent: Any) -> Any:
    """Read an entry of an extract's file; raises ``UserError`` if the file is damaged."""
    try:
        found = load_json(path).get(name, absent)
    except (OSError, ValueError, AttributeError) as error:
        raise UserError(f"{path} cannot be read ({reason(error)}): extract the object again.") from error
    if found is not absent and not isinstance(found, kind) or found == "":
        raise UserError(f"{path} has no usable {name!r}: extract the object again.")
    return found


def files_digest(folder: Path) -> str:
    """Return a digest of the masks and the grid in a folder; that of no file if none was prepared there."""
    whole = (folder / "grid.pt").exists()
    return content_digest([folder / "grid.pt", *sorted((folder / "masks").glob("*.png"))] if whole else [])
