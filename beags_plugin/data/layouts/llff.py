"""LLFF's forward-facing scenes."""

from __future__ import annotations

from pathlib import Path

from beags_plugin.data.dataset import ColmapModel, Dataset, PoseTable
from beags_plugin.data.files import largest_images, size_note
from beags_plugin.data.layout import Layout
from beags_plugin.data.layouts.colmap import complete_model, points_file
from beags_plugin.data.poses_bounds import FILE, read_poses_bounds


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
        return (root / FILE).is_file()

    def read(self, root: Path, images: Path | None) -> Dataset:
        folder, downscale = largest_images(root, images)
        poses, points = model_or_bounds(root, folder)
        note = "" if images else size_note(folder, downscale)
        return Dataset(self.title, root, poses, seed_points=points, downscale=downscale, size_note=note)


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
