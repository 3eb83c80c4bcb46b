"""SPIn-NeRF: masks of one object beside the smaller copies of the images."""

from __future__ import annotations

from pathlib import Path

from beags_plugin.data.dataset import Dataset, Split
from beags_plugin.data.files import choose_images, image_folders, list_images
from beags_plugin.data.layout import Layout
from beags_plugin.data.layouts.llff import lacks_poses, model_or_bounds
from beags_plugin.system.wording import amount, verb

LABELS = "label"


class SpinNerf(Layout):
    """images_4/<image>, images_4/label/<stem>.png (or another size), and sparse/0 or poses_bounds.npy.

    Views before the first labelled one, in the order of names, show the scene without the object and are left out.
    Every 8th of the others is held out.
    """

    title = "SPIn-NeRF"
    marks = "images_4/label"
    refines = ("colmap", "llff", "mipnerf360")

    def missing(self, root: Path) -> str | None:
        if root.is_file() or _labelled(root) is None:
            return "no folder of labels (images_4/label)"
        return lacks_poses(root)

    def read(self, root: Path, images: Path | None) -> Dataset:
        own = _labelled(root)
        folder = choose_images(root, images or own)
        labels = (folder if (folder / LABELS).is_dir() else own or folder) / LABELS
        stems = [path.stem for path in list_images(folder)]
        labelled = [stem for stem in stems if (labels / f"{stem}.png").is_file()]
        gone = stems[: stems.index(labelled[0])] if labelled and set(stems[-len(labelled) :]) == set(labelled) else []
        poses, points = model_or_bounds(root, folder)
        note, are = amount(len(gone), "image"), verb(len(gone), "are")
        note += f" before the first label {are} left out: the object is gone there."
        return Dataset(
            self.title,
            root,
            poses,
            Split(left_out=tuple(gone)),
            masks=labels,
            mask_kind="binary",
            class_names={1: "object"},
            seed_points=points,
            notes=(note,) if gone else (),
        )


def _labelled(root: Path) -> Path | None:
    """Find the folder of the smallest images with labels; None without."""
    folders = [folder for folder in image_folders(root) if any((folder / LABELS).glob("*.png"))]
    return folders[-1] if folders else None
