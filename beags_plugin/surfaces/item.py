"""What is exported or made a surface of: an object, the views of the training photos, and the photos themselves."""

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
    depth: [H, W] of the whole scene, in the file's units along z, 0 where nothing is. edge: pixels from the mask's
    border within which it may not be right. sharper: the same part of the photo with more pixels, nearer to those of
    its file; None where there are no more.
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
