"""One view of a scene as the data manager gives it, and what views are called."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import chain, count
from pathlib import Path

import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.labels.label_maps import to_int32


@dataclass(frozen=True)
class View:
    """One undistorted view, on the data manager's device.

    It shares the data manager's memory, or reads the files where images are streamed; what is asked of it is computed
    anew: of all views at once, the images in float would take six times as much as their files, opened.

    name: the stem of the image file; where several share it, with the folders that tell them apart, joined by "_".
    data: gives what batches hold of it. labels_of: gives its labels, as ``label_maps.to_compact`` does, or None.
    """

    camera: Camera
    name: str
    data: Callable[[], dict[str, Tensor]]
    labels_of: Callable[[], Tensor] | None

    @property
    def pixels(self) -> Tensor:
        """[H, W, 3 or more], uint8 or float32 in 0..1."""
        return self.data()["image"]

    @property
    def stored_labels(self) -> Tensor | None:
        """[H, W] class ids in the narrowest type; None if the view has no mask."""
        return None if self.labels_of is None else self.labels_of()

    @property
    def opacity(self) -> Tensor | None:
        """[H, W] uint8, or None."""
        return self.data().get("alpha")

    @property
    def image(self) -> Tensor:
        """[H, W, 3] float32 in 0..1, on black where it has alpha."""
        pixels = self.pixels[..., :3]
        return pixels.float() / 255.0 if pixels.dtype == torch.uint8 else pixels

    @property
    def labels(self) -> Tensor | None:
        """[H, W] int32 class ids or IGNORE; None if the view has no mask."""
        stored = self.stored_labels
        return None if stored is None else to_int32(stored)

    @property
    def alpha(self) -> Tensor | None:
        """[H, W] float32 in 0..1, the image's alpha; None if it is opaque."""
        opacity = self.opacity
        return None if opacity is None else opacity.float() / 255.0

    def image_on(self, background: Tensor) -> Tensor:
        """The image [H, W, 3] with ``background`` [3] behind what is transparent."""
        alpha = self.alpha
        return self.image if alpha is None else self.image + (1.0 - alpha)[..., None] * background


def unique_names(files: Sequence[Path]) -> list[str]:
    """For each file its stem; stems that several share get their folders before them, and a number if need be."""
    parts = [Path(file).with_suffix("").parts for file in files]
    depth = 1
    while len({path[-depth:] for path in parts}) < len(set(parts)):
        depth += 1
    stems = Counter(path[-1] for path in parts)
    taken = {stem for stem, uses in stems.items() if uses == 1}
    names = []
    for path in parts:
        name = path[-1]
        if stems[name] > 1:
            whole = "_".join(path[-depth:])
            name = next(n for n in chain([whole], (f"{whole}_{i}" for i in count(2))) if n not in taken)
            taken.add(name)
        names.append(name)
    return names
