"""The interface of mask sources, and what they are given."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import ClassVar, Protocol

import numpy as np
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.masks.sources.matching import PhotoNames
from beags_plugin.system.errors import UserError
from beags_plugin.system.reading.images import read_image

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Photo:
    """One view: its name (see ``data.files.photo_names``), the file, and its width and height in pixels; trained: not
    held out."""

    name: str
    path: Path
    width: int
    height: int
    trained: bool = True

    def pixels(self) -> np.ndarray:
        """[H, W, 3] uint8 RGB."""
        # a copy: torch wants memory that can be written to
        return read_image(self.path, lambda image: np.array(image.convert("RGB")))


class Geometry(Protocol):
    """The scene's own shape, from a trained run: of its views, held-out ones included, without lens distortion."""

    @property
    def images(self) -> Sequence[Path]:
        """The photographs of its views."""
        ...

    @property
    def cameras(self) -> Sequence[Camera]:
        """Without distortion, of the photographs' size."""
        ...

    def depth(self, view: int) -> Tensor:
        """[h, w] float32, depth of the surface, 0 where nothing is."""
        ...

    def to_straight(self, labels: np.ndarray, view: int) -> np.ndarray:
        """[h, w] uint16: a class map [H, W] of the photograph without its lens distortion."""
        ...

    def to_photo(self, labels: np.ndarray, view: int) -> np.ndarray:
        """[H, W] uint16: a class map [h, w] with the photograph's lens distortion."""
        ...


@dataclass(frozen=True)
class SourceScene:
    """What masks are made for. root: the scene's folder. geometry: None unless a trained run was given."""

    root: Path
    photos: Sequence[Photo]
    geometry: Geometry | None = None

    @cached_property
    def names(self) -> PhotoNames:
        """What the photos are called."""
        return PhotoNames([photo.name for photo in self.photos])

    def index_of(self, name: str, whose: str) -> int:
        """The place of the view that ``name`` means; ``whose`` says in the error where it was named."""
        found = self.names.find(name, whose)
        if found is None:
            raise UserError(f"{whose} names the view {name!r}, but no image of {self.root} is called so: correct it.")
        return found

    def places(self) -> list[int]:
        """Of each view of ``geometry`` its place among the photos; ``UserError`` if it is of another scene."""
        assert self.geometry is not None
        known = {photo.path.resolve(): index for index, photo in enumerate(self.photos)}
        for image in self.geometry.images:
            if image.resolve() not in known:
                raise UserError(
                    f"the run was trained on {image}, which is no image of {self.root}: give --load-config a run that "
                    "was trained on the same images."
                )
        return [known[image.resolve()] for image in self.geometry.images]

    def below(self, path: Path) -> Path:
        """The path in the scene's folder, if it is not absolute and exists there; else as it is."""
        inside = self.root / path
        return inside if not path.is_absolute() and inside.exists() else path


@dataclass(frozen=True)
class MadeMasks:
    """Class names by id, and one class map [H, W] uint16 per photo in their order; None: no mask for that view.

    notes: sentences to tell the user, filled while the maps are made. to_look_at: places of photos whose maps are
    neither to be trained on nor to be scored against.
    """

    names: Mapping[int, str]
    maps: Iterator[np.ndarray | None]
    notes: list[str]
    to_look_at: frozenset[int] = frozenset()


class MaskSource(ABC):
    """Makes the masks of a scene. A source is a frozen dataclass; its own fields are its options.

    needs_run: whether it works only with ``SourceScene.geometry``.
    """

    needs_run: ClassVar[bool] = False

    @classmethod
    def unavailable(cls) -> str | None:
        """None, or one sentence on why it cannot run here."""
        return None

    @abstractmethod
    def make(self, scene: SourceScene, progress: Progress) -> MadeMasks:
        """The masks of all photos; raises ``UserError`` for input that cannot be used. progress: (done, total)."""


def per_photo(
    scene: SourceScene, progress: Progress, read: Callable[[Photo], np.ndarray | None]
) -> Iterator[np.ndarray | None]:
    """``read`` of each photo, with progress; raises ``UserError`` where a map has another size than its photo."""
    for index, photo in enumerate(scene.photos):
        labels = read(photo)
        if labels is not None and labels.shape != (photo.height, photo.width):
            raise UserError(
                f"the masks of {photo.path} are {labels.shape[1]}x{labels.shape[0]} pixels but the image is "
                f"{photo.width}x{photo.height}: make them from the image at its full size."
            )
        yield labels
        progress(index + 1, len(scene.photos))


def stacked(objects: Sequence[tuple[int, np.ndarray]], shape: tuple[int, int]) -> np.ndarray:
    """[H, W] uint16: the masks [H, W] bool of objects by id in one map; where they overlap, the smaller one is seen."""
    labels = np.zeros(shape, np.uint16)
    for class_id, mask in sorted(objects, key=lambda pair: (-int(pair[1].sum()), pair[0])):
        labels[mask] = class_id
    return labels
