"""LERF-Mask: id images of the training views, and masks by text prompt of the test views."""

from __future__ import annotations

from pathlib import Path

from beags_plugin.data.dataset import ColmapModel, Dataset, Split
from beags_plugin.data.files import choose_images, list_images, size_note
from beags_plugin.data.layout import Layout, stem_of
from beags_plugin.data.layouts.colmap import checked_model, model_folder


class LerfMask(Layout):
    """images, images_train, object_mask/<stem>.png (ids), test_mask/<n>/<prompt>.png and sparse/0.

    By default images have their own size, as in the paper. Test views are the images that images_train/ lacks; <n>
    counts them from 0 in the order of their names.
    """

    title = "LERF-Mask"
    marks = "object_mask and test_mask"
    refines = ("colmap", "mipnerf360")

    def missing(self, root: Path) -> str | None:
        if root.is_file() or model_folder(root) is None:
            return "no COLMAP model (sparse/0)"
        return next((f"no folder {name}" for name in ("images_train", "test_mask") if not (root / name).is_dir()), None)

    def read(self, root: Path, images: Path | None) -> Dataset:
        folder = choose_images(root, images or root / "images")
        trained = {path.stem for path in list_images(root / "images_train")}
        test = [path.stem for path in list_images(folder) if path.stem not in trained]
        return Dataset(
            self.title,
            root,
            ColmapModel(checked_model(root), folder),
            Split(tuple(test), every=False),
            masks=root / "object_mask",
            visible=_masks_by_prompt(root / "test_mask", test),
            size_note="" if images else size_note(folder),
        )


def _masks_by_prompt(folder: Path, test: list[str]) -> dict[str, dict[str, Path]]:
    """Find the masks of the test views by prompt and stem; raise ``UserError`` for a folder of no test view."""
    masks: dict[str, dict[str, Path]] = {}
    for view in sorted(path for path in folder.iterdir() if path.is_dir()):
        stem = stem_of(view, test, "test view")
        for file in sorted(view.glob("*.png")):
            masks.setdefault(file.stem, {})[stem] = file
    return masks
