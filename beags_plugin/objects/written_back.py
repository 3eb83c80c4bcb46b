"""Write a refined scene of another program back in its own format, and count what changed."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from beags_plugin.core.surfels import Surfels
from beags_plugin.export.base import make_exporter
from beags_plugin.importers.base import ImportedScene
from beags_plugin.objects.export import export_run
from beags_plugin.splat_io.files import whole_file

_SPLIT = 2.0  # distance, in standard deviations of a Gaussian, within which its halves lie


@dataclass(frozen=True)
class FileFormat:
    """An exporter and its options. note: a sentence if the scene's own format cannot be written, else ""."""

    exporter: str
    options: dict[str, Any]
    note: str = ""


def format_of(path: Path, scene: ImportedScene) -> FileFormat:
    """Return how to write back a scene that was read from ``path``."""
    kind = scene.kind
    if kind.startswith(".spz"):
        older = kind.endswith("2")
        note = "Version 2 of .spz tilts thin discs, so version 3 is written." if older else ""
        return FileFormat("spz", {"version": 4 if kind.endswith("4") else 3}, note)
    if kind.startswith("USD"):
        kernel = "surflet" if "surflets" in kind else "ellipsoid"
        return FileFormat("usda-splats" if path.suffix.lower() == ".usda" else "usdz-splats", {"kernel": kernel})
    names = {"3DGS .ply": "ply", "2DGS .ply": "ply-2dgs", "compressed .ply": "compressed-ply"}
    names |= {".sog": "sog", ".sog of discs": "sog", ".splat": "splat", "glTF of splats": "gltf-splats"}
    if (name := names.get(kind)) is not None:
        return FileFormat(name, {})
    return FileFormat("ply", {}, f"A {kind} cannot be written, so a .ply of 3DGS is.")


def write_back(config_path: Path, wanted: FileFormat, folder: Path, stem: str, objects: Sequence[str]) -> list[Path]:
    """Write the whole scene of a refined run to ``folder``, and each of some objects beside it; return the files.

    The scene is called ``stem``.cleaned, an object ``stem``.NAME; both lie in the world of the input poses.
    """
    suffix = make_exporter(wanted.exporter, **wanted.options).suffix
    written = []
    with tempfile.TemporaryDirectory() as made:
        exported = export_run(
            config_path, objects, formats=[wanted.exporter], output=Path(made), whole=True,
            options={wanted.exporter: wanted.options},
        )  # fmt: skip
        for one in exported:
            (file,) = one.files
            assert file.path is not None  # export_run raises for what it cannot write
            title = "cleaned" if one.class_id is None else file.path.name.removesuffix(f".{suffix}")
            target = folder / f"{stem}.{title}.{suffix}"
            with whole_file(target) as part:
                shutil.copyfile(file.path, part)
            written.append(target)
    return written[-1:] + written[:-1]


@dataclass(frozen=True)
class Changes:
    """Numbers of Gaussians before and after refinement.

    kept: pairs that are each other's nearest. moved: of these, pairs that moved by more than the Gaussian's larger
    scale. median: of the distances over that scale. split: removed Gaussians with new ones in their place. dropped:
    other removed Gaussians. new: Gaussians after refinement that are in no pair.
    """

    before: int
    after: int
    kept: int
    moved: int
    median: float
    split: int
    dropped: int
    new: int

    def __str__(self) -> str:
        """Return a line for users."""
        return (
            f"{self.before:,} Gaussians became {self.after:,}: {self.kept:,} were kept, of which {self.moved:,} moved "
            f"by more than their size, {self.split:,} were split and {self.dropped:,} dropped; {self.new:,} are new"
        )


def changes(before: Surfels, after: Surfels) -> Changes:
    """Compare two states of one scene.

    Gaussians have no ids, so those whose means are each other's nearest count as the same. A removed one was split if a
    new one lies within two standard deviations of its larger scale.
    """
    from scipy.spatial import KDTree

    first, second = (each.means.detach().double().cpu().numpy() for each in (before, after))
    if not len(first) or not len(second):
        return Changes(len(first), len(second), 0, 0, 0.0, 0, len(first), len(second))
    way, there = (np.atleast_1d(found) for found in KDTree(second).query(first))
    back = np.atleast_1d(KDTree(first).query(second)[1])
    same = back[there] == np.arange(len(first))
    sizes = torch.exp(before.log_scales.detach().double().amax(dim=1)).cpu().numpy()
    relative = way[same] / np.maximum(sizes[same], 1e-300)
    kept = int(same.sum())
    median = float(np.median(relative)) if kept else 0.0
    new = np.ones(len(second), bool)
    new[there[same]] = False
    split = 0
    if new.any() and not same.all():
        apart = np.atleast_1d(KDTree(second[new]).query(first[~same])[0])
        split = int((apart <= _SPLIT * sizes[~same]).sum())
    gone = len(first) - kept
    return Changes(
        len(first), len(second), kept, int((relative > 1.0).sum()), median, split, gone - split, len(second) - kept
    )
