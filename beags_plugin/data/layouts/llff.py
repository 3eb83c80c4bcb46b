"""LLFF's forward-facing scenes; the view that NVOS scores is held out."""

from __future__ import annotations

from pathlib import Path

from beags_plugin.data.dataset import ColmapModel, Dataset, PoseTable, Split
from beags_plugin.data.files import image_folders, largest_images, list_images, width_note
from beags_plugin.data.layout import Layout
from beags_plugin.data.layouts.colmap import complete_model, points_file
from beags_plugin.data.poses_bounds import FILE, read_poses_bounds
from beags_plugin.system.errors import UserError
from beags_plugin.system.reading.text import read_text, reason

NVOS_TARGETS = {
    "fern": "IMG_4027",
    "flower": "IMG_2962",
    "fortress": "IMG_1800",
    "horns": "DJI_20200223_163024_597",
    "leaves": "IMG_2997",
    "orchids": "IMG_4480",
    "trex": "DJI_20200223_163619_411",
}
"""Scene to the stem of the camera's file of the view that NVOS scores (method, section 9)."""
ORIGINAL_NAMES = "original_names.txt"


class Llff(Layout):
    """images, and poses in a complete COLMAP model, else in poses_bounds.npy.

    By default the largest images are scaled to 1600 pixels wide, as in the paper; narrower ones keep their size.
    """

    title = "LLFF"
    marks = FILE
    refines = ("colmap", "mipnerf360")

    def missing(self, root: Path) -> str | None:
        return lacks_poses(root)

    def recognises(self, root: Path) -> bool:
        return (root / FILE).is_file() or (root.name.lower() in NVOS_TARGETS and complete_model(root) is not None)

    def read(self, root: Path, images: Path | None) -> Dataset:
        folder, downscale = largest_images(root, images)
        poses, points = model_or_bounds(root, folder)
        split, note = Split(nvos_target(root, folder)), "" if images else width_note(folder)
        return Dataset(self.title, root, poses, split, seed_points=points, downscale=downscale, size_note=note)


def lacks_poses(root: Path) -> str | None:
    """Return a description of the two sources of poses if ``root`` has neither; else None."""
    if root.is_dir() and ((root / FILE).is_file() or complete_model(root) is not None):
        return None
    return f"neither {FILE} nor a complete COLMAP model (sparse/0)"


def model_or_bounds(root: Path, images: Path) -> tuple[ColmapModel | PoseTable, Path | None]:
    """Return the poses of the images in a folder, and their seed points.

    COLMAP's poses take precedence over LLFF's, as they include the lens. Smaller copies of the images may have other
    names in the same order, as LLFF makes them.
    """
    model = complete_model(root)
    if model is not None:
        return ColmapModel(model, images, in_order=True), None
    return read_poses_bounds(root / FILE, images), points_file(root / "sparse" / "0")  # poses and points share a world


def nvos_target(root: Path, folder: Path) -> tuple[str, ...]:
    """Return the stem in ``folder`` of the view that NVOS scores, or the camera's stem if that is unknown.

    LLFF numbers its smaller copies (image000.png, ...) in the order of the camera's names: those in images/, or the
    second column of original_names.txt. Returns () for other scenes.
    """
    target = NVOS_TARGETS.get(root.name.lower())
    if target is None:
        return ()
    return (camera_names(root, folder).get(target, target),)


def camera_names(root: Path, folder: Path) -> dict[str, str]:
    """Return {stem of the camera's file: stem of its copy in ``folder``}, as far as known; see ``nvos_target``.

    Files of ``folder`` itself keep their names.
    """
    stems = [path.stem for path in list_images(folder)]
    pairs = dict(zip((path.stem for path in _originals(root, len(stems))), stems, strict=False))
    if (root / ORIGINAL_NAMES).is_file():
        try:
            lines = [_columns(line) for line in read_text(root / ORIGINAL_NAMES).splitlines()]
        except (OSError, ValueError) as error:
            raise UserError(
                f"{root / ORIGINAL_NAMES} cannot be read ({reason(error)}): restore or remove it."
            ) from error
        pairs |= {Path(names[1]).stem: Path(names[0]).stem for names in lines if len(names) == 2}
    return pairs | {stem: stem for stem in stems}


def _columns(line: str) -> list[str]:
    """Return the name of a copy, and the rest of the line, that of the camera's file; a tab or spaces divide them."""
    return [name.strip() for name in (line.split("\t", 1) if "\t" in line else line.split(maxsplit=1))]


def _originals(root: Path, count: int) -> list[Path]:
    """Return the images with the camera's names, if there are ``count``."""
    folders = image_folders(root)
    files = list_images(folders[0]) if folders else []
    return files if len(files) == count else []
