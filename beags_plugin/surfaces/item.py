"""An item to export or to make a surface of: an object, the training views, and the photos."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.core.surfels import Surfels
from beags_plugin.rasterizers.interface import Rasterizer, RasterSettings
from beags_plugin.system.errors import UserError


class NothingToExport(UserError):
    """An item holds nothing that a format can store; with --all, the other items are written all the same."""


@dataclass(frozen=True)
class Viewpoints:
    """The training cameras, and the rasterizer of their views; all in the frame of the file.

    scene: the whole scene with the item, whose other parts hide the item in the views; None if unknown.
    """

    cameras: Sequence[Camera]
    rasterizer: Rasterizer
    settings: RasterSettings
    scene: Surfels | None = None


@dataclass(frozen=True)
class Photo:
    """A training photo and its mask of an item; the functions may read files.

    camera: in the frame of the file. image: [H, W, 3] float32 in 0..1, sRGB. own: [H, W] bool, the item's mask.
    depth: [H, W] of the whole scene, in the file's units along z, 0 where it is empty. edge: pixels from the mask's
    border within which the mask may be wrong. sharper: the same part of the photo in a higher resolution; None where
    the photo has none.
    """

    camera: Camera
    image: Callable[[], Tensor]
    own: Callable[[], Tensor]
    depth: Callable[[], Tensor]
    edge: int = 1
    sharper: Photo | None = None


@dataclass(frozen=True)
class ExportItem:
    """An object or the background to export, in the frame of the file.

    name: the user's name of it. surfels: N Gaussians. class_ids: [N] int32, phi.
    views: those of the training photos; None unless an exporter ``needs_views``.
    photos: those of the item; None unless an exporter ``needs_photos``, or if there are none, for the reason
        ``no_photos``.
    in_metres: whether the frame's unit is the metre; otherwise it is unknown.
    close: whether meshes shall be closed where no photo shows the item.
    invented: [N] bool, Gaussians that close it there; None if it was not to be closed.
    class_names: the names of ``class_ids``, for files that hold several objects.
    shared: results that exporters of one item share, such as the mesh of two file types.
    on_render: an exporter that ``needs_views`` calls it with the number of views rendered so far.
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
