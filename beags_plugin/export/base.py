"""The interface of exporters."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.core.surfels import Surfels
from beags_plugin.extraction.far_worlds import to_world
from beags_plugin.rasterizers.interface import Rasterizer, RasterSettings
from beags_plugin.system.errors import UserError


class NothingToExport(UserError):
    """An item has nothing of what a format holds; with --all the other items are written all the same."""


@dataclass(frozen=True)
class Viewpoints:
    """The training cameras, and the rasterizer for views from there; all in the frame of the file.

    scene: the whole scene, what an item is a part of; no view sees the item where the rest hides it. None if unknown.
    """

    cameras: Sequence[Camera]
    rasterizer: Rasterizer
    settings: RasterSettings
    scene: Surfels | None = None


@dataclass(frozen=True)
class Photo:
    """A training photo and what it shows of an item; what returns tensors may read files.

    camera: in the frame of the file. image: [H, W, 3] float32 in 0..1, sRGB. own: [H, W] bool, the item's mask.
    depth: [H, W] of the whole scene, in the file's units along z, 0 where nothing is.
    """

    camera: Camera
    image: Callable[[], Tensor]
    own: Callable[[], Tensor]
    depth: Callable[[], Tensor]


@dataclass(frozen=True)
class ExportItem:
    """An object or the background to export, in the frame of the file.

    name: as the user calls it. surfels: N surfels. class_ids: [N] int32, phi.
    views: of the training photos; None unless an exporter ``needs_views``.
    photos: of the item; None unless an exporter ``needs_photos``, or where there are none, as ``no_photos`` says.
    in_metres: whether the frame's unit is a metre; else it is unknown.
    close: whether meshes shall be closed where no photo shows the item.
    invented: [N] bool, surfels that close it there; None where it was not asked to be closed.
    class_names: of the ids among ``class_ids``, for files that hold several objects.
    shared: what exporters of one item keep for each other, such as the mesh that two file types hold.
    on_render: is called, by an exporter that ``needs_views``, with the number of views rendered so far.
    """

    name: str
    surfels: Surfels
    class_ids: Tensor
    views: Viewpoints | None = None
    shared: dict[Any, Any] = field(default_factory=dict)
    on_render: Callable[[int], None] = lambda done: None
    photos: Sequence[Photo] | None = None
    no_photos: str = "no photos were given"
    in_metres: bool = False
    close: bool = False
    invented: Tensor | None = None
    class_names: Mapping[int, str] = field(default_factory=dict)


class Exporter(ABC):
    """One file format. Subclasses are frozen dataclasses; their own fields, all with defaults, are their options.

    suffix: how the files' names end. needs_views: whether it renders the item from the views of the training photos.
    needs_metres: whether its files state a unit of length. holds_gaussians: whether they hold Gaussians; where objects
    are closed, its items then have more of these, and else it closes them itself.
    """

    suffix: ClassVar[str]
    needs_views: ClassVar[bool] = False
    needs_metres: ClassVar[bool] = False
    holds_gaussians: ClassVar[bool] = True

    @property
    def needs_photos(self) -> bool:
        """Return whether it looks at the photos themselves."""
        return False

    @classmethod
    def unavailable(cls) -> str | None:
        """Return None if this exporter can run here, else one sentence: why not and what to install."""
        return None

    def to_world(self, path: Path, origin: Tensor) -> bool:
        """Move a file that ``write`` made about ``origin`` [3] float64 to the world, in double precision.

        Returns False, and changes nothing, where the format cannot hold it.
        """
        return to_world(path, origin)

    @abstractmethod
    def write(self, path: Path, item: ExportItem) -> dict[str, Any]:
        """Write ``item`` to ``path``; return the manifest's entries about the file (plain values by name).

        Raises ``UserError`` if the file cannot be written, ``NothingToExport`` if the item has nothing for it.
        """


def make_exporter(name: str, **options: Any) -> Exporter:
    """Return the exporter called ``name``; raises ``UserError`` for an unknown name, or if it cannot run here."""
    from beags_plugin.export import EXPORTERS

    exporter = EXPORTERS.get(name)
    if reason := exporter.unavailable():
        raise UserError(f"the exporter {name!r} cannot run here: {reason}")
    return exporter(**options)
