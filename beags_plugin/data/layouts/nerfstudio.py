"""nerfstudio's own layout: transforms.json."""

from __future__ import annotations

from pathlib import Path

from beags_plugin.data.dataset import Dataset, TransformsFile
from beags_plugin.data.layout import Layout


class NerfstudioLayout(Layout):
    """A folder with transforms.json, or any transforms .json."""

    title = "nerfstudio"
    marks = "transforms.json"
    refines = ("colmap", "llff", "mipnerf360")

    def missing(self, root: Path) -> str | None:
        return None if root.is_file() or (root / "transforms.json").is_file() else "no transforms.json"

    def read(self, root: Path, images: Path | None) -> Dataset:
        file = root if root.is_file() else root / "transforms.json"
        return Dataset(self.title, file.parent, TransformsFile(file, images))
