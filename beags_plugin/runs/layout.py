"""Runs on disk: a folder with config.yml and a checkpoint, on which every ns-* command works."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from beags_plugin.system.digests import content_digest
from beags_plugin.system.errors import UserError
from beags_plugin.system.reading.text import load_json, reason

BASE_SNAPSHOT = "base"  # Folder with the scene that refinement started from.
PREPARED = "prepared"  # Folder with the masks and grids of refinement.
EXTRACTION_FILE = "extraction.json"  # An extracted run names here its origin and its object.
REPORT_FILE = "training.json"  # A complete run has here seconds, memory and a refiner's own figures.


def newest_checkpoint(folder: Path) -> Path:
    """Return the checkpoint of the highest step in a nerfstudio_models folder; raises ``UserError`` if none."""
    checkpoints = sorted(folder.glob("step-*.ckpt")) if folder.is_dir() else []
    if not checkpoints:
        raise UserError(
            f"{folder} holds no checkpoint (step-….ckpt): train longer, copy the whole run, or name another."
        )
    return checkpoints[-1]


def refinable(models: Path) -> Path:
    """Return the nerfstudio_models folder to refine from: that of the run's base if there is one, else ``models``.

    models: the run's own folder. So a refined scene is not refined again.
    """
    base = models.parent / BASE_SNAPSHOT / models.name
    return base if any(base.glob("step-*.ckpt")) else models


def preparing_run(run: Path) -> Path:
    """Return the run whose preparation applies to ``run``: itself, or the run of which it is the base or an extract."""
    origin = run / EXTRACTION_FILE
    if origin.exists():
        recorded = Path(_origin(origin, "run", str, "")).parent
        if run.parent.name == "extracted" and (run.parent.parent / "config.yml").exists():
            recorded = run.parent.parent  # Both may have been moved together from the recorded place.
        return preparing_run(recorded)
    return run.parent if run.name == BASE_SNAPSHOT and (run.parent / PREPARED).is_dir() else run


def digest_of_prepared(run: Path) -> str | None:
    """Return a digest of the masks and the grid that refinement of ``run`` was prepared with, if it was.

    For an extract the digest is as old as the extraction; None if its file has none.
    """
    origin = run / EXTRACTION_FILE
    return _origin(origin, "prepared", str, None) if origin.exists() else files_digest(preparing_run(run) / PREPARED)


def _origin(path: Path, name: str, kind: type, absent: Any) -> Any:
    """Read an entry of an extract's file; raises ``UserError`` if the file is damaged."""
    try:
        value = load_json(path).get(name, absent)
    except (OSError, ValueError, AttributeError) as error:
        raise UserError(f"{path} cannot be read ({reason(error)}): extract the object again.") from error
    if value is not absent and not isinstance(value, kind) or value == "":
        raise UserError(f"{path} has no usable {name!r}: extract the object again.")
    return value


def files_digest(folder: Path) -> str:
    """Return a digest of the masks and the grid in a folder; the digest of no files if none was prepared there."""
    whole = (folder / "grid.pt").exists()
    return content_digest([folder / "grid.pt", *sorted((folder / "masks").glob("*.png"))] if whole else [])
