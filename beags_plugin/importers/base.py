"""The interface of importers, which read a scene that another program or another run has trained."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

from torch import Tensor

from beags_plugin.core.flattening import Gaussians
from beags_plugin.importers.activation import StartValues, stored_values
from beags_plugin.system.errors import UserError
from beags_plugin.system.pasted import command

_OTHERS: dict[str, Callable[[Path], str]] = {
    **dict.fromkeys((".ksplat", ".lcc"), lambda path: command(["splat-transform", path, path.with_suffix(".ply")])),
    ".gz": lambda path: command(["gunzip", "-k", path]),
    ".zip": lambda path: command(["unzip", path]),
    ".7z": lambda path: command(["7z", "x", path]),
}
"""Commands of other programs that convert formats without an importer."""
_CHECKPOINTS = (".pt", ".pth")  # gsplat's examples and 3DGS write these beside a .ply


@dataclass(frozen=True)
class ImportedScene:
    """A scene as a file holds it.

    kind: its name for users, such as "3DGS .ply". gaussians: N, flat or with volume, not yet checked for odd values.
    normalization: None if the scene lies in the world of the input poses; else ([3, 4] float64 R | t, scale) of its
    frame x' = scale (R x + t).
    note: a sentence for the user if the scene is assumed to lie in this run's own frame, or "".
    remarks: other sentences for the user: what the format loses and what was assumed.
    free_values: whether the format does not specify scales and opacities, so that some programs write them activated.
    exact_means: [N, 3] float64, the means if they lie too far from 0 for single precision; else None.
    doubtful_axes: whether programs disagree on the axes of the format, so that the scene may be rotated by 90 degrees.
    """

    kind: str
    gaussians: Gaussians
    normalization: tuple[Tensor, float] | None = None
    note: str = ""
    remarks: tuple[str, ...] = ()
    free_values: bool = False
    exact_means: Tensor | None = None
    doubtful_axes: bool = False


class Importer(ABC):
    """One kind of file or folder.

    marks: the files that it reads, for messages.
    """

    marks: ClassVar[str]

    @abstractmethod
    def recognises(self, path: Path) -> bool:
        """Return whether this importer reads the existing ``path``; looks at as little of it as possible."""

    @abstractmethod
    def read(self, path: Path) -> ImportedScene:
        """Read the scene in float32; raises ``UserError`` if it cannot be read, is damaged, or is something else."""


def find_importer(path: Path) -> Importer:
    """Return the importer that recognises ``path``.

    Raises ``UserError`` if ``path`` does not exist, or if no importer or several recognise it.
    """
    from beags_plugin.importers import IMPORTERS

    if not path.exists():
        raise UserError(f"{path} does not exist: name a splat file, a checkpoint or a run to start from.")
    importers: dict[str, Importer] = {name: IMPORTERS.get(name)() for name in IMPORTERS.names()}
    fitting = [name for name, importer in importers.items() if importer.recognises(path)]
    if not fitting:
        if (convert := _OTHERS.get(path.suffix.lower())) is not None:
            raise UserError(f"{path} is of a format that is not read: convert it first, as by {convert(path)}")
        if path.suffix.lower() in _CHECKPOINTS:
            raise UserError(f"{path} is a checkpoint of another program: name the .ply that it writes beside it.")
        known = "; ".join(importer.marks for importer in importers.values())
        raise UserError(f"{path} is nothing to start from: name one of these: {known}.")
    if len(fitting) > 1:
        raise UserError(f"{path} can be read as {' or '.join(fitting)}: export it as a .ply and name that.")
    return importers[fitting[0]]


def read_scene(path: Path, values: StartValues = "auto") -> ImportedScene:
    """Read the scene of ``path`` with scales as logs and opacities as logits, whichever the file has.

    values: what the file has; "auto" decides by their ranges. Raises ``UserError`` like ``find_importer`` and
    ``Importer.read``, and if the ranges are ambiguous.
    """
    scene = find_importer(path).read(path)
    if scene.free_values:
        gaussians, remarks = stored_values(path, scene.gaussians, values)
        return replace(scene, gaussians=gaussians, remarks=(*scene.remarks, *remarks))
    if values != "auto":
        raise UserError(f"{path} ({scene.kind}) says itself what its scales and opacities are: leave start-values out.")
    return scene
