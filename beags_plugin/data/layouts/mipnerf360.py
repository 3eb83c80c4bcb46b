"""Mip-NeRF 360: COLMAP, and smaller copies of the images beside them."""

from __future__ import annotations

from pathlib import Path

from beags_plugin.data.dataset import ColmapModel, Dataset
from beags_plugin.data.files import choose_images, image_folders
from beags_plugin.data.layout import Layout
from beags_plugin.data.layouts.colmap import checked_model, model_folder

SCENES = ("bicycle", "bonsai", "counter", "flowers", "garden", "kitchen", "room", "stump", "treehill")
FOLDERS = {"images", "images_2", "images_4", "images_8"}


class MipNerf360(Layout):
    """images, images_2, images_4, images_8 and sparse/0; every 8th view is for evaluation.

    Taken is the largest of the folders whose images have at most 1600 pixels on a side: images_4 of the scenes
    outdoors and images_2 of those indoors, as the data set's papers do.
    """

    title = "Mip-NeRF 360"
    marks = "sparse/0 with images, images_2, images_4 and images_8"
    refines = ("colmap",)

    def missing(self, root: Path) -> str | None:
        return "no COLMAP model (sparse/0)" if root.is_file() or model_folder(root) is None else None

    def recognises(self, root: Path) -> bool:
        if self.missing(root) is not None:
            return False
        folders = {folder.name for folder in image_folders(root)}
        return folders >= FOLDERS or (root.name in SCENES and bool(folders))

    def read(self, root: Path, images: Path | None) -> Dataset:
        return Dataset(self.title, root, ColmapModel(checked_model(root), choose_images(root, images)))
