"""A data set as its layout reads it: the files, and the protocol of its evaluation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

MaskKind = Literal["ids", "binary"]
"""Images of class ids, or binary masks of one object (``labels.classes.read_object_mask``)."""


@dataclass(frozen=True)
class ColmapModel:
    """Poses in a COLMAP model, binary or text.

    folder: of the model. images: folder of the images that it names. in_order: if no file has a name of the model,
    files and names are paired in the order of names.
    """

    folder: Path
    images: Path
    in_order: bool = False


@dataclass(frozen=True)
class TransformsFile:
    """Poses in nerfstudio's transforms.json; ``images``, unless None, replaces the folder of its file_path."""

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
    missing: where the photos of other poses of the file should lie, which are left out of these.
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

    held_out: stems of images that the protocol names. every: also hold out each ``eval_interval``-th view in the order
    of names. left_out: stems of images for neither training nor evaluation.
    """

    held_out: tuple[str, ...] = ()
    every: bool = True
    left_out: tuple[str, ...] = ()


FilesOfObject = Mapping[str, Path]
"""Stem of an image to the binary mask of one object in it."""


@dataclass(frozen=True)
class Dataset:
    """A data set of one scene as its layout describes it.

    layout: title of the layout. root: folder of the data set.
    masks, mask_kind: folder of the training masks <stem>.png, which may be missing, and their kind.
    mask_files: stem of an image to its mask, if masks have other names; or None.
    class_names: id to name, or None; class_names_file: their file, for messages.
    visible, silhouettes: object name to exact masks for evaluation: of its visible part, and occlusion-free.
    seed_points: .ply, or COLMAP's points3D.bin or .txt, in the frame of a ``PoseTable``; None: the poses bring them.
    downscale: factor by which the images' sides are divided by default, for the size that the data set's papers use.
    notes: sentences for the user. size_note: a sentence about the size of the images, where the layout chose it.
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
    downscale: float = 1.0
    notes: tuple[str, ...] = ()
    size_note: str = ""
