"""Mip-NeRF 360: COLMAP, and smaller copies of the images beside them."""

from __future__ import annotations

from pathlib import Path

from beags_plugin.data.dataset import ColmapModel, Dataset
from beags_plugin.data.files import choose_images, image_folders, list_images, size_note
from beags_plugin.data.layouts.colmap import Colmap, checked_model

SCENES = ("bicycle", "bonsai", "counter", "flowers", "garden", "kitchen", "room", "stump", "treehill")
QUARTER = "images_4"
FOLDERS = {"images", "images_2", "images_4", "images_8"}


class MipNerf360(Colmap):
    """images, images_2, images_4, images_8 and sparse/0; every 8th view is for evaluation.

    By default the images of images_4 are used, as in the paper, else those of ``choose_images``.
    """

    title = "Mip-NeRF 360"
    marks = "sparse/0 with images, images_2, images_4 and images_8"
    refines = ("colmap",)

    def recognises(self, root: Path) -> bool:
        if self.missing(root) is not None:
            return False
        folders = {folder.name for folder in image_folders(root)}
        return folders >= FOLDERS or (root.name in SCENES and bool(folders))

    def read(self, root: Path, images: Path | None) -> Dataset:
        quarter = root / QUARTER
        folder = choose_images(root, images or (quarter if list_images(quarter) else None))
        note = "" if images else size_note(folder)
        return Dataset(self.title, root, ColmapModel(checked_model(root), folder), size_note=note)
