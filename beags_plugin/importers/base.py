"""The interface of importers, which read a scene that another program, or another run, has trained."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from torch import Tensor

from beags_plugin.core.flattening import Gaussians
from beags_plugin.system.errors import UserError


@dataclass(frozen=True)
class ImportedScene:
    """A scene as a file holds it.

    kind: its name for users, as in "3DGS .ply". gaussians: N, flat or with volume; not yet checked for odd values.
    normalization: None if the file lies in the world of the input poses; else ([3, 4] float64 R | t, scale) of the
    frame x' = scale (R x + t) that it lies in.
    note: a sentence that the user should read, or "".
    """

    kind: str
    gaussians: Gaussians
    normalization: tuple[Tensor, float] | None = None
    note: str = ""


class Importer(ABC):
    """One kind of file or folder.

    marks: the files that it reads, for messages.
    """

    marks: ClassVar[str]

    @abstractmethod
    def recognises(self, path: Path) -> bool:
        """Return whether to take the existing ``path`` where the user named no importer; reads as little as it can."""

    @abstractmethod
    def read(self, path: Path) -> ImportedScene:
        """Read the scene in ``path``; raise ``UserError`` if it cannot be read. Trust no counts and sizes."""


def find_importer(path: Path) -> Importer:
    """Return the importer that recognises ``path``.

    Raises ``UserError`` if there is no ``path``, no such importer, or none or several that take ``path``.
    """
    from beags_plugin.importers import IMPORTERS

    if not path.exists():
        raise UserError(f"{path} does not exist: name a .ply, a checkpoint or a run to start from.")
    importers: dict[str, Importer] = {name: IMPORTERS.get(name)() for name in IMPORTERS.names()}
    fitting = [name for name, importer in importers.items() if importer.recognises(path)]
    if not fitting:
        known = "; ".join(importer.marks for importer in importers.values())
        raise UserError(f"{path} is nothing to start from: name one of these: {known}.")
    if len(fitting) > 1:
        raise UserError(f"{path} can be read as {' or '.join(fitting)}: export it as a .ply and name that.")
    return importers[fitting[0]]
