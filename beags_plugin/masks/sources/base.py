"""The interface of mask sources, with their input and output."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import ClassVar, Protocol, TypeVar

import numpy as np

from beags_plugin.core.cameras import Camera
from beags_plugin.data.orientation import LYING, orientation, upright, upright_mask_error
from beags_plugin.masks.sources.matching import PhotoNames
from beags_plugin.system.errors import UserError
from beags_plugin.system.reading.images import read_image
from beags_plugin.system.threads import worker_threads

Progress = Callable[[int, int], None]
T = TypeVar("T")


class NothingFound(UserError):
    """A source found no object in any photo."""


@dataclass(frozen=True)
class Photo:
    """The photo of a view.

    name: see ``data.files.photo_names``. path: of the file. width, height: pixels. trained: False if held out. turned:
    EXIF's orientation of the file if masks are made of the upright photo, to which width and height then refer; else 1.
    """

    name: str
    path: Path
    width: int
    height: int
    trained: bool = True
    turned: int = 1

    def pixels(self, enough: int | None = None) -> np.ndarray:
        """Read the photo, [H, W, 3] uint8 RGB, in writable memory, as torch needs it.

        enough: pixels of its longer side that suffice; it may then be smaller than ``width`` x ``height``.
        """
        image = read_image(self.path, lambda image: np.array(image.convert("RGB")), enough=enough)
        return upright(image, self.turned)

    def upright(self) -> Photo:
        """Return the photo turned upright by its EXIF orientation."""
        turned = orientation(self.path)
        sides = (self.height, self.width) if turned in LYING else (self.width, self.height)
        return replace(self, width=sides[0], height=sides[1], turned=turned)


class Geometry(Protocol):
    """Cameras of all views of a trained run, without lens distortion."""

    @property
    def images(self) -> Sequence[Path]:
        """Photos of the views."""
        ...

    @property
    def cameras(self) -> Sequence[Camera]:
        """Cameras of the photos' size."""
        ...

    def to_straight(self, labels: np.ndarray, view: int) -> np.ndarray:
        """Remove the photo's lens distortion from labels [H, W]; return [h, w] uint16."""
        ...

    def to_photo(self, labels: np.ndarray, view: int) -> np.ndarray:
        """Apply the photo's lens distortion to labels [h, w]; return [H, W] uint16."""
        ...


@dataclass(frozen=True)
class SourceScene:
    """The scene that a source masks. root: its folder. geometry: None without a trained run."""

    root: Path
    photos: Sequence[Photo]
    geometry: Geometry | None = None

    @cached_property
    def names(self) -> PhotoNames:
        """Names of the photos."""
        return PhotoNames([photo.name for photo in self.photos])

    def by_photo(self, files: Mapping[str, Path]) -> dict[str, Path]:
        """Return the file of each photo, by the photo's name; files: by their own names; raise ``UserError``."""
        return {self.photos[index].name: path for index, path in self.names.assigned(files, str).items()}

    def index_of(self, name: str, whose: str) -> int:
        """Return the index of the view called ``name``; raise ``UserError``. whose: file that names it, for errors."""
        index = self.names.find(name, whose)
        if index is None:
            raise UserError(f"{whose} names the view {name!r}, but {self.root} has no image of that name: correct it.")
        return index

    def prompted_view(self, name: str, path: Path) -> int:
        """Return the index of a view that the prompts in ``path`` name; raise ``UserError`` also if it is held out."""
        index = self.index_of(name, str(path))
        if not self.photos[index].trained or (self.geometry is not None and index not in self.places):
            raise UserError(f"{path} has prompts in {name}, which is held out: prompt a training view.")
        return index

    @cached_property
    def places(self) -> list[int]:
        """Return the photo index of each view of ``geometry``; raise ``UserError`` for another scene."""
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
        """Return the path below the scene's folder if it exists there, else the path itself."""
        inside = self.root / path
        return inside if not path.is_absolute() and inside.exists() else path


@dataclass(frozen=True)
class MadeMasks:
    """Class names by id, and per photo its labels [H, W] uint16, or None.

    notes: sentences for the user, added while the maps are made.
    """

    names: Mapping[int, str]
    maps: Iterator[np.ndarray | None]
    notes: list[str]


class MaskSource(ABC):
    """Interface of the sources: frozen dataclasses whose fields are their options.

    needs_run: True if ``SourceScene.geometry`` is needed. guesses: True if a program draws the masks, so that they are
    no ground truth, and held-out views get none; False if the source reads masks made elsewhere.
    """

    needs_run: ClassVar[bool] = False
    guesses: ClassVar[bool] = False

    @classmethod
    def unavailable(cls) -> str | None:
        """Return a sentence on why the source cannot run here, or None."""
        return None

    def check(self) -> None:  # noqa: B027  (most sources need no weights)
        """Raise ``UserError``, before other work, if files or weights that the options name are not available."""

    @abstractmethod
    def make(self, scene: SourceScene, progress: Progress) -> MadeMasks:
        """Make the masks of all photos; raise ``UserError`` for unusable input. progress: (done, total)."""


def per_photo(
    scene: SourceScene, progress: Progress, read: Callable[[Photo], np.ndarray | None]
) -> Iterator[np.ndarray | None]:
    """Yield ``read`` of each photo, with progress; raise ``UserError`` for labels of another size than the photo.

    The next photo is read in a thread while the caller writes the labels of this one.
    """
    for index, (photo, labels) in enumerate(zip(scene.photos, _ahead(read, scene.photos), strict=True)):
        if labels is not None and labels.shape != (photo.height, photo.width):
            size = labels.shape[1], labels.shape[0]
            if sentence := upright_mask_error("made here", size, photo.path, (photo.width, photo.height)):
                raise UserError(sentence)
            raise UserError(
                f"the masks of {photo.path} are {labels.shape[1]}x{labels.shape[0]} pixels but the image is "
                f"{photo.width}x{photo.height}: make them from the image at its full size."
            )
        yield labels
        progress(index + 1, len(scene.photos))


def _ahead(read: Callable[[Photo], T], photos: Sequence[Photo]) -> Iterator[T]:
    """Yield ``read`` of each photo; one is read ahead."""
    with worker_threads(1) as pool:
        following: Future[T] | None = None
        for photo in photos:
            current, following = following, pool.submit(read, photo)
            if current is not None:
                yield current.result()
        if following is not None:
            yield following.result()


def stacked(objects: Sequence[tuple[int, np.ndarray]], shape: tuple[int, ...]) -> np.ndarray:
    """Combine masks [H, W] bool of objects by id into labels [H, W] uint16; smaller objects cover larger ones."""
    labels = np.zeros(shape, np.uint16)
    for class_id, mask in sorted(objects, key=lambda pair: (-int(pair[1].sum()), pair[0])):
        labels[mask] = class_id
    return labels
