"""The interface of exporters."""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any, ClassVar

from torch import Tensor

from beags_plugin.splat_io.far_worlds import to_world
from beags_plugin.surfaces.item import ExportItem, NothingToExport, Photo, Viewpoints
from beags_plugin.system.errors import UserError

__all__ = ["ExportItem", "Exporter", "NothingToExport", "Photo", "Viewpoints", "make_exporter"]


class Exporter(ABC):
    """One file format. Subclasses are frozen dataclasses; their own fields, all with defaults, are their options.

    suffix: how the files' names end. needs_views: whether it renders the item from the views of the training photos.
    needs_photos: whether it reads the photos themselves. needs_metres: whether its files state a unit of length.
    holds_gaussians: whether the files hold Gaussians. Where objects are closed, items of such exporters have additional
    Gaussians; other exporters close the objects themselves.
    """

    suffix: ClassVar[str]
    needs_views: ClassVar[bool] = False
    needs_photos: ClassVar[bool] = False
    needs_metres: ClassVar[bool] = False
    holds_gaussians: ClassVar[bool] = True

    @classmethod
    def unavailable(cls) -> str | None:
        """Return None if this exporter can run here, else one sentence: why not and what to install."""
        return None

    def without_mesh(self) -> Exporter | None:
        """Return an exporter of the same file without its mesh; None if nothing else is in it."""
        return None if self.needs_photos else self

    def to_world(self, path: Path, origin: Tensor) -> bool:
        """Move a file that ``write`` made relative to ``origin`` [3] float64 to the world, in double precision.

        Returns False, and changes nothing, where the format cannot hold it.
        """
        return to_world(path, origin)

    @abstractmethod
    def write(self, path: Path, item: ExportItem) -> dict[str, Any]:
        """Write ``item`` to ``path``; return the manifest's entries about the file (plain values by name).

        Raises ``UserError`` if the file cannot be written, ``NothingToExport`` if the item holds nothing for it.
        """


def make_exporter(name: str, **options: Any) -> Exporter:
    """Return the exporter called ``name``; raises ``UserError`` for an unknown name, or if it cannot run here."""
    from beags_plugin.export import EXPORTERS

    exporter = EXPORTERS.get(name)
    if reason := exporter.unavailable():
        raise UserError(f"the exporter {name!r} cannot run here: {reason}")
    return exporter(**options)
