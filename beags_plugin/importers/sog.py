"""PlayCanvas' .sog, version 2, read as its specification says (developer.playcanvas.com, "The SOG Format").

A zip of WebP images with one pixel for each Gaussian, and meta.json; or the same files unzipped beside meta.json.
"""

from __future__ import annotations

import io
import json
import math
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from beags_plugin.core.sh import num_sh_bases
from beags_plugin.importers.base import ImportedScene, Importer
from beags_plugin.importers.packed import cut_bands, gaussians_of, reading, with_largest

_META = "meta.json"
_ROW = 64  # palette entries in a row of their image
_TAG = 252  # plus the place of the component that a rotation leaves out


class SogImporter(Importer):
    """In the world of the input poses, as .ply files."""

    marks: ClassVar[str] = "a .sog"

    def recognises(self, path: Path) -> bool:
        return path.is_file() and (path.suffix.lower() == ".sog" or path.name == _META)

    def read(self, path: Path) -> ImportedScene:
        with reading(path, ".sog"):
            if path.name == _META:
                return _scene(lambda name: (path.parent / _inside(name)).read_bytes())
            with zipfile.ZipFile(path) as archive:
                return _scene(archive.read)


def _inside(name: str) -> str:
    """Return the name of a file beside another; raises ``ValueError`` where it leads out of the folder."""
    if Path(name).name != name:
        raise ValueError(f"it names the file {name!r}")
    return name


def _scene(content: Callable[[str], bytes]) -> ImportedScene:
    """Return the scene of the files that ``content`` returns."""
    meta = json.loads(content(_META))
    if meta.get("version") != 2:
        raise ValueError(f"its version is {meta.get('version')}, but 2 is read")
    count = int(meta["count"])

    def pixels(block: str, file: int = 0) -> np.ndarray:
        found = _image(content(meta[block]["files"][file])).reshape(-1, 4)[:count]
        if len(found) < count:
            raise ValueError(f"an image of its {block} has {len(found)} of {count} pixels")
        return found

    low, high = (np.array(meta["means"][end], np.float64) for end in ("mins", "maxs"))
    logs = low + (256 * pixels("means", 1)[:, :3] + pixels("means")[:, :3]) / 65535 * (high - low)
    quats, sh0 = pixels("quats"), pixels("sh0")
    scales = _values(meta, "scales")[pixels("scales")[:, :3]]
    place = quats[:, 3] - _TAG
    if ((place < 0) | (place > 3)).any():
        raise ValueError("its rotations name no component")
    bands, rest = 0, np.zeros((count, 0, 3))
    if "shN" in meta:
        bands = int(meta["shN"]["bands"])
        rest = _bands(meta, _image(content(meta["shN"]["files"][0])), pixels("shN", 1), num_sh_bases(bands) - 1)
    flat = meta.get("model") == "2dgs"
    gaussians = gaussians_of(
        np.sign(logs) * np.expm1(np.abs(logs)),
        with_largest((quats[:, :3] / 255 - 0.5) * math.sqrt(2), place),
        scales[:, :2] if flat else scales,
        sh0[:, 3] / 255,
        _values(meta, "sh0")[sh0[:, :3]],
        rest,
    )
    lost = "It is compressed: scales, colours and bands are the nearest of a table, rotations and opacities 8 bits."
    return ImportedScene(".sog of discs" if flat else ".sog", gaussians, remarks=(lost, *cut_bands(bands)))


def _image(data: bytes) -> np.ndarray:
    """Return [H, W, 4] int64."""
    from PIL import Image

    with Image.open(io.BytesIO(data)) as image:
        return np.asarray(image.convert("RGBA")).astype(np.int64)


def _values(meta: dict[str, Any], block: str) -> np.ndarray:
    return np.array(meta[block]["codebook"], np.float64)


def _bands(meta: dict[str, Any], palette: np.ndarray, labels: np.ndarray, coefficients: int) -> np.ndarray:
    """Return [N, coefficients, 3] of the entries that ``labels`` [N, 4] name in the image of the palette."""
    entries = labels[:, 0] + 256 * labels[:, 1]
    if len(entries) and entries.max() >= int(meta["shN"]["count"]):
        raise ValueError("a Gaussian names an entry that its palette lacks")
    columns = (entries % _ROW)[:, None] * coefficients + np.arange(coefficients)
    return _values(meta, "shN")[palette[(entries // _ROW)[:, None], columns, :3]]
