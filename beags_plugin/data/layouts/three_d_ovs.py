"""3D-OVS: masks of every class in a few views."""

from __future__ import annotations

from pathlib import Path

from beags_plugin.data.dataset import Dataset, Split
from beags_plugin.data.files import largest_images, list_images, size_note
from beags_plugin.data.layout import Layout, stem_of
from beags_plugin.data.layouts.llff import lacks_poses, model_or_bounds
from beags_plugin.system.errors import UserError
from beags_plugin.system.reading.text import read_text, reason

CLASSES = "segmentations/classes.txt"


class ThreeDOvs(Layout):
    """images, segmentations/classes.txt, segmentations/<NN>/<class>.png, and poses_bounds.npy or sparse/0.

    The views in segmentations/ are held out; <NN> is the stem of an image or its place in the order of names.
    Ids are the lines of classes.txt from 1 on.
    """

    title = "3D-OVS"
    marks = CLASSES
    refines = ("colmap", "llff", "mipnerf360")

    def missing(self, root: Path) -> str | None:
        if root.is_file() or not (root / CLASSES).is_file():
            return f"no {CLASSES}"
        return lacks_poses(root)

    def read(self, root: Path, images: Path | None) -> Dataset:
        folder, downscale = largest_images(root, images)
        stems = [path.stem for path in list_images(folder)]
        names = _class_names(root / CLASSES)
        visible: dict[str, dict[str, Path]] = {}
        held_out = []
        for view in sorted(path for path in (root / CLASSES).parent.iterdir() if path.is_dir()):
            stem = stem_of(view, stems, "image")
            held_out.append(stem)
            for name in names:
                if (view / f"{name}.png").is_file():
                    visible.setdefault(name, {})[stem] = view / f"{name}.png"
        poses, points = model_or_bounds(root, folder)
        return Dataset(
            self.title,
            root,
            poses,
            Split(tuple(held_out), every=not held_out),
            class_names=dict(enumerate(names, start=1)),
            class_names_file=root / CLASSES,
            visible=visible,
            seed_points=points,
            downscale=downscale,
            size_note="" if images else size_note(folder, downscale),
        )


def _class_names(file: Path) -> list[str]:
    try:
        names = [line.strip() for line in read_text(file).splitlines() if line.strip()]
    except (OSError, ValueError) as error:
        raise UserError(f"{file} cannot be read ({reason(error)}): write one class name on each line.") from error
    if not names or len(set(names)) < len(names):
        raise UserError(f"{file} names {'a class twice' if names else 'no class'}: write one name on each line.")
    return names
