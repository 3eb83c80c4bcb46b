"""One view of a scene as the data manager gives it, and the names of views."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import chain, count
from pathlib import Path

import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera


@dataclass(frozen=True)
class View:
    """One undistorted view, on the data manager's device.

    It shares the data manager's memory, or reads the files if images are streamed. Its properties are computed each
    time, as the images of all views in float would take four times the memory of those in bytes.

    name: the stem of the image file; if several share it, with the folders that differ, joined by "_". data: returns
    ``image`` [H, W, 3 or more], uint8 or float32 in 0..1, and ``alpha`` [H, W] uint8 if there is any. labels_of:
    returns [H, W] int32 class ids or IGNORE, or None if the view has no mask.
    """

    camera: Camera
    name: str
    data: Callable[[], dict[str, Tensor]]
    labels_of: Callable[[], Tensor | None]

    @property
    def labels(self) -> Tensor | None:
        """Return the class ids or IGNORE, [H, W] int32; None if the view has no mask."""
        return self.labels_of()

    @property
    def image(self) -> Tensor:
        """Return the image [H, W, 3] float32 in 0..1, on black where it is transparent."""
        return in_unit_range(self.data()["image"])

    def image_on(self, background: Tensor) -> Tensor:
        """Return the image [H, W, 3] with ``background`` [3] behind what is transparent."""
        data = self.data()
        image, alpha = in_unit_range(data["image"]), data.get("alpha")
        return image if alpha is None else image + (1.0 - alpha.float() / 255.0)[..., None] * background


def in_unit_range(pixels: Tensor) -> Tensor:
    """Return the colours [H, W, 3] float32 in 0..1 of ``View.data``'s image."""
    return pixels[..., :3].float() / 255.0 if pixels.dtype == torch.uint8 else pixels[..., :3]


def unique_names(files: Sequence[Path]) -> list[str]:
    """Return the stem of each file; a shared stem gets its folders before it, and a number if still needed."""
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
