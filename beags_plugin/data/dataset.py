"""What a layout says of a scene: where its files are, and what its protocol is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

MaskKind = Literal["ids", "binary"]
"""Images of class ids, or of one object: not 0 is inside, see ``labels.classes.read_binary_mask``."""


@dataclass(frozen=True)
class ColmapModel:
    """Poses in a COLMAP model, binary or text.

    folder: of the model. images: folder of the images that it names. in_order: where no file has the name that the
    model says, the files stand for its images in the order of their names.
    """

    folder: Path
    images: Path
    in_order: bool = False


@dataclass(frozen=True)
class TransformsFile:
    """Poses in nerfstudio's transforms.json; ``images`` replaces the folder that its file_path names, or is None."""

    file: Path
    images: Path | None = None


@dataclass(frozen=True)
class PoseTable:
    """Poses that the layout has read itself, V views in the order of their names.

    images: V files. camera_to_world: [V, 3, 4] float64, OpenGL axes (x right, y up, z backward), any world.
    K: [V, 3, 3] float64, pixels of ``sizes``. sizes: [V, 2] integer width and height; the files may be smaller copies.
    bounds: [V, 2] float64, nearest and farthest depth in the world's units, or None.
    lens: COLMAP's cameras.bin or cameras.txt, whose only camera made all images: its lens distortion; or None.
    file: what messages call the source of these poses.
    """

    file: Path
    images: tuple[Path, ...]
    camera_to_world: npt.NDArray[np.float64]
    K: npt.NDArray[np.float64]
    sizes: npt.NDArray[np.int64]
    bounds: npt.NDArray[np.float64] | None = None
    lens: Path | None = None


Poses = ColmapModel | TransformsFile | PoseTable


@dataclass(frozen=True)
class Split:
    """Which views are held out for evaluation.

    held_out: stems of images that the protocol names. every: whether every so many (``eval_interval``) of the
    name-sorted views are held out besides. left_out: stems of images that serve neither purpose.
    """

    held_out: tuple[str, ...] = ()
    every: bool = True
    left_out: tuple[str, ...] = ()


FilesOfObject = Mapping[str, Path]
"""Stem of an image to the binary mask of one object in it."""


@dataclass(frozen=True)
class Dataset:
    """A scene as its layout describes it.

    layout: what to call it. root: its folder. poses: where they come from.
    masks, mask_kind: the folder of the masks <stem>.png to train on, which may be missing, and what they are.
    mask_files: stem of an image to its mask, where they are called otherwise; or None.
    class_names: id to name, or None; class_names_file: where they stand (for messages).
    visible, silhouettes: object name to its exact masks for evaluation: of what is seen of it, and of what it covers
        with nothing before it. More may lie in the folder of the ground truth.
    seed_points: .ply, or COLMAP's points3D.bin or .txt, in the frame of a ``PoseTable``, or None; the other kinds of
        poses know their own.
    notes: sentences to tell the user.
    """

    layout: str
    root: Path
    poses: Poses
    split: Split = Split()
    masks: Path = Path("masks")
    mask_kind: MaskKind = "ids"
    mask_files: Mapping[str, Path] | None = None
    class_names: Mapping[int, str] | None = None
    class_names_file: Path | None = None
    visible: Mapping[str, FilesOfObject] = field(default_factory=dict)
    silhouettes: Mapping[str, FilesOfObject] = field(default_factory=dict)
    seed_points: Path | None = None
    notes: tuple[str, ...] = ()
