"""A data set as its layout reads it: its files, and which of its views are held out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from beags_plugin.system.errors import UserError, meant


@dataclass(frozen=True)
class ColmapModel:
    """Poses in a COLMAP model, binary or text.

    folder: of the model. images: folder of the images that it names. in_order: whether files and names may be paired in
    the order of names if no file has a name of the model.
    """

    folder: Path
    images: Path
    in_order: bool = False


@dataclass(frozen=True)
class TransformsFile:
    """Poses in nerfstudio's transforms.json. images: folder that replaces that of its file_path, or None."""

    file: Path
    images: Path | None = None


@dataclass(frozen=True)
class PoseTable:
    """Poses of V views in the order of their names, read by the layout.

    file: source of the poses, for messages. images: V files.
    camera_to_world: [V, 3, 4] float64, OpenGL axes (x right, y up, z backward), any world.
    K: [V, 3, 3] float64, pixels of ``sizes``. sizes: [V, 2] integer width and height; the files may be smaller copies.
    bounds: [V, 2] float64, nearest and farthest depth, world units, or None.
    lens: COLMAP's cameras.bin or cameras.txt with one camera, for its lens distortion, or None.
    missing: paths of photos that have a pose in the file but do not exist; their poses are left out.
    """

    file: Path
    images: tuple[Path, ...]
    camera_to_world: npt.NDArray[np.float64]
    K: npt.NDArray[np.float64]
    sizes: npt.NDArray[np.int64]
    bounds: npt.NDArray[np.float64] | None = None
    lens: Path | None = None
    missing: tuple[Path, ...] = ()


Poses = ColmapModel | TransformsFile | PoseTable


@dataclass(frozen=True)
class Split:
    """Protocol of the held-out views.

    held_out: stems of images that the protocol names. every: whether every ``eval_interval``-th view in the order of
    names is held out too.
    """

    held_out: tuple[str, ...] = ()
    every: bool = True


FilesOfObject = Mapping[str, Path]
"""Stem of an image, to the binary mask of one object in it."""


@dataclass(frozen=True)
class Dataset:
    """A data set of one scene as its layout describes it.

    layout: title of the layout. root: folder of the data set.
    masks: folder of the training masks <stem>.png, images of class ids; it may be missing.
    class_names: id to name, or None. class_names_file: their file, for messages.
    visible: object name to exact masks of its visible part, for evaluation.
    seed_points: .ply, or COLMAP's points3D.bin or .txt, in the frame of a ``PoseTable``; None if the poses bring them.
    downscale: factor by which the images' sides are divided by default, to the size that the data set's papers use.
    size_note: a sentence on the size of the images if the layout chose it, or "".
    """

    layout: str
    root: Path
    poses: Poses
    split: Split = Split()
    masks: Path = Path("masks")
    class_names: Mapping[int, str] | None = None
    class_names_file: Path | None = None
    visible: Mapping[str, FilesOfObject] = field(default_factory=dict)
    seed_points: Path | None = None
    downscale: float = 1.0
    size_note: str = ""


def split_views(
    names: Sequence[set[str]], split: Split, interval: int, held_out: Sequence[str] = ()
) -> tuple[list[int], list[int]]:
    """Return the indices of the training and of the evaluation views; without held-out views, all serve as both.

    names: for each view, in the order of names, its names: that of its file and that in the poses. interval: of
    ``Split.every``; 0 for none. held_out: names from the user, in addition to the protocol's. Raises ``UserError`` if a
    name of ``held_out`` does not exist, or no training view is left.
    """
    known = set().union(*names)
    if unknown := sorted(set(held_out) - known):
        near = meant(unknown[0], known)
        raise UserError(f"held_out names {unknown[0]!r}, but no image has that stem{near}: correct the name.")
    out = set(range(0, len(names), interval)) if split.every and interval > 0 else set()
    out |= {index for index, own in enumerate(names) if not own.isdisjoint({*split.held_out, *held_out})}
    train = [index for index in range(len(names)) if index not in out]
    if not train:
        raise UserError(f"all {len(names)} views are held out for evaluation: add views or change eval_interval.")
    return train, sorted(out) or train
