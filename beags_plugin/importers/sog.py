"""Importer of PlayCanvas' .sog, version 2 (developer.playcanvas.com, "The SOG Format").

The format is a zip of meta.json and WebP images with one pixel for each Gaussian, or the same files unzipped.
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
_ROW = 64  # palette entries in a row of the palette image
_LARGEST_META = 1 << 24  # bytes of meta.json
_UNPACKED, _SMALL = 4, 1 << 16  # largest expansion of an image in the zip, and bytes that are always allowed
_PACKED = 64  # largest number of Gaussians per byte of positions, unless all have one position
_PALETTE = 1 << 24  # largest palette image, pixels
_TAG = 252  # value of a rotation's alpha, plus the index of the component that is left out


class SogImporter(Importer):
    """A .sog or its unzipped folder, in the world of the input poses like .ply files."""

    marks: ClassVar[str] = "a .sog"

    def recognises(self, path: Path) -> bool:
        if path.is_dir():
            return (path / _META).is_file()
        return path.is_file() and (path.suffix.lower() == ".sog" or path.name == _META)

    def read(self, path: Path) -> ImportedScene:
        path = path / _META if path.is_dir() else path
        with reading(path, ".sog"):
            if path.name == _META:
                return _scene(lambda name: (path.parent / _inside(name)).read_bytes())
            with zipfile.ZipFile(path) as archive:
                return _scene(lambda name: _member(archive, name))


def _member(archive: zipfile.ZipFile, name: str) -> bytes:
    """Return a file of an archive; raises ``ValueError`` for one that unpacks to far more than real files.

    The bound holds for the unpacked bytes, not for the size that the archive states.
    """
    most = _LARGEST_META if name == _META else _UNPACKED * archive.getinfo(name).compress_size + _SMALL
    with archive.open(name) as file:
        content = file.read(most + 1)
    if len(content) > most:
        raise ValueError(f"its {name} unpacks to more than {most:,} bytes")
    return content


def _inside(name: str) -> str:
    """Return a file's name; raises ``ValueError`` if it leads out of the folder."""
    if Path(name).name != name:
        raise ValueError(f"it names the file {name!r}")
    return name


def _scene(content: Callable[[str], bytes]) -> ImportedScene:
    """Return the scene; content: returns the bytes of a file by its name."""
    meta = json.loads(content(_META))
    if meta.get("version") != 2:
        raise ValueError(f"its version is {meta.get('version')}, but 2 is read")
    count = int(meta["count"])
    lowest = content(meta["means"]["files"][0])  # the lower bytes of positions hardly compress
    if not 0 <= count <= _PACKED * len(lowest) + _SMALL:
        raise ValueError(f"it promises {count} Gaussians, which do not fit into it")

    def pixels(block: str, file: int = 0) -> np.ndarray:
        values = _image(content(meta[block]["files"][file]), 4 * count + _SMALL).reshape(-1, 4)[:count]
        if len(values) < count:
            raise ValueError(f"an image of its {block} has {len(values)} of {count} pixels")
        return values

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
        rest = _bands(
            meta, _image(content(meta["shN"]["files"][0]), _PALETTE), pixels("shN", 1), num_sh_bases(bands) - 1
        )
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


def _image(data: bytes, most: int) -> np.ndarray:
    """Return an image [H, W, 4] int64; raises ``ValueError`` if it has more than ``most`` pixels."""
    from PIL import Image

    with Image.open(io.BytesIO(data), formats=["WEBP", "PNG"]) as image:
        if image.width * image.height > most:
            raise ValueError(f"an image of it has {image.width} x {image.height} pixels")
        return np.asarray(image.convert("RGBA")).astype(np.int64)


def _values(meta: dict[str, Any], block: str) -> np.ndarray:
    return np.array(meta[block]["codebook"], np.float64)


def _bands(meta: dict[str, Any], palette: np.ndarray, labels: np.ndarray, coefficients: int) -> np.ndarray:
    """Return the coefficients [N, coefficients, 3] of the palette entries that ``labels`` [N, 4] name."""
    entries = labels[:, 0] + 256 * labels[:, 1]
    if len(entries) and entries.max() >= int(meta["shN"]["count"]):
        raise ValueError("a Gaussian names an entry that its palette lacks")
    columns = (entries % _ROW)[:, None] * coefficients + np.arange(coefficients)
    return _values(meta, "shN")[palette[(entries // _ROW)[:, None], columns, :3]]
