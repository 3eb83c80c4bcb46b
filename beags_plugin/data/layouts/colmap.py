"""Any data set with a COLMAP model, binary or text, and functions that other layouts share."""

from __future__ import annotations

from pathlib import Path

from beags_plugin.data.dataset import ColmapModel, Dataset
from beags_plugin.data.layout import Layout
from beags_plugin.system.errors import UserError
from beags_plugin.system.reading.text import read_text, reason

FOLDERS = ("sparse/0", "colmap/sparse/0", "sparse")


def model_folder(root: Path) -> Path | None:
    """Find the folder of a COLMAP model below ``root``, complete or not; None without."""
    for name in FOLDERS:
        if any((root / name / f"{part}.{end}").is_file() for part in ("cameras", "images") for end in ("bin", "txt")):
            return root / name
    return None


def missing_part(folder: Path) -> str | None:
    """Return the name of a file that a COLMAP model lacks, or None."""
    end = "txt" if (folder / "cameras.txt").is_file() else "bin"  # nerfstudio's order
    return next((f"{part}.{end}" for part in ("cameras", "images") if not (folder / f"{part}.{end}").is_file()), None)


def complete_model(root: Path) -> Path | None:
    """Find the folder of a complete COLMAP model below ``root``, or None."""
    folder = model_folder(root)
    return folder if folder is not None and missing_part(folder) is None else None


def checked_model(root: Path) -> Path:
    """Find the folder of the COLMAP model below ``root``; raise ``UserError`` if a part is missing."""
    folder = model_folder(root)
    if folder is None:
        raise UserError(f"{root} holds no COLMAP model (sparse/0): run COLMAP first.")
    if part := missing_part(folder):
        raise UserError(f"the COLMAP model {folder} lacks {part}: export the complete model again.")
    return folder


def points_file(folder: Path) -> Path | None:
    """Return the file of a COLMAP model's seed points; None if there is none, or its list is empty.

    An empty binary file, as an interrupted download leaves it, is returned, so that reading it raises an error.
    """
    binary, text = folder / "points3D.bin", folder / "points3D.txt"
    if binary.is_file():  # nerfstudio's order; the file starts with a 64-bit count
        with binary.open("rb") as file:
            count = file.read(8)
        return binary if any(count) or not count else None
    if not text.is_file():
        return None
    try:
        lines = read_text(text).splitlines()
    except (OSError, ValueError) as error:
        raise UserError(f"{text} cannot be read ({reason(error)}): export the model again.") from error
    return text if any(line.strip() and not line.startswith("#") for line in lines) else None


class Colmap(Layout):
    """A COLMAP model in sparse/0 with its images in images/."""

    title = "COLMAP"
    marks = "sparse/0"

    def missing(self, root: Path) -> str | None:
        return "no COLMAP model (sparse/0)" if root.is_file() or model_folder(root) is None else None

    def read(self, root: Path, images: Path | None) -> Dataset:
        return Dataset(self.title, root, ColmapModel(checked_model(root), images or root / "images"))
