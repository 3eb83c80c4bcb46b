"""Gaussians as a .sog: PlayCanvas' Spatially Ordered Gaussians, version 2, for web pages.

Written from the format's specification (developer.playcanvas.com, "The SOG Format"): a zip of lossless WebP images with
one pixel per Gaussian, and meta.json. Means have 16 bits after p -> sign(p) log(1 + |p|); the three smaller components
of a rotation have 8; log scales, colours and coefficients are indices of tables of 256 values; the higher bands of a
Gaussian are one entry of a palette.
"""

from __future__ import annotations

import io
import json
import math
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from beags_plugin.export.base import Exporter
from beags_plugin.export.palettes import nearest, palette_of, table_of
from beags_plugin.export.splat_values import SplatValues, smallest_three, splat_values
from beags_plugin.splat_io.files import write_bytes
from beags_plugin.surfaces.item import ExportItem

VERSION = 2
_TABLE = 256  # values of a table
_ROW = 64  # palette entries in a row of their image
_ROTATION_TAG = 252  # added to the index of the component that is left out


@dataclass(frozen=True)
class SogExporter(Exporter):
    """PlayCanvas' .sog: SuperSplat, the PlayCanvas and Babylon.js engines, Spark. It cannot hold class ids."""

    suffix: ClassVar[str] = "sog"

    def write(self, path: Path, item: ExportItem) -> dict[str, Any]:
        content, facts = sog(splat_values(item.surfels, item.name))
        write_bytes(path, content)
        return facts


def sog(values: SplatValues) -> tuple[bytes, dict[str, Any]]:
    """Return the content of the file, and the manifest's entries about it."""
    images: dict[str, np.ndarray] = {}
    meta = {"version": VERSION, "asset": {"generator": "beags"}, "count": len(values), "antialias": False}
    meta["model"] = "2dgs"  # Readers that support discs ignore the third scale.
    meta["means"] = _means(values.means, images)
    largest, others = smallest_three(values.quats)
    rotations = np.rint(255.0 * (others / 2 + 0.5)).clip(0, 255)
    images["quats.webp"] = _image(np.column_stack([rotations, _ROTATION_TAG + largest]))
    meta["quats"] = {"files": ["quats.webp"]}
    table, places = _in_table(values.log_scales)
    images["scales.webp"] = _image(places)
    meta["scales"] = {"codebook": table, "files": ["scales.webp"]}
    table, places = _in_table(values.sh_dc)
    alphas = np.rint(255.0 * values.opacities).clip(1, 254)  # 0 and 255 mean infinite logits.
    images["sh0.webp"] = _image(np.column_stack([places, alphas]))
    meta["sh0"] = {"codebook": table, "files": ["sh0.webp"]}
    entries = 0
    if values.sh_rest.shape[1]:
        meta["shN"] = _bands(values.sh_rest, images)
        entries = meta["shN"]["count"]
    facts = {"version": VERSION, "sh_degree": math.isqrt(1 + values.sh_rest.shape[1]) - 1, "palette": entries}
    return _zip(meta, images), facts


def _means(means: np.ndarray, images: dict[str, np.ndarray]) -> dict[str, Any]:
    logs = np.sign(means) * np.log1p(np.abs(means))
    low, high = logs.min(axis=0), logs.max(axis=0)
    places = np.rint(65535.0 * (logs - low) / np.where(high > low, high - low, 1.0)).astype(np.uint16)
    images["means_l.webp"], images["means_u.webp"] = _image(places & 255), _image(places >> 8)
    return {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]}


def _in_table(values: np.ndarray) -> tuple[list[float], np.ndarray]:
    """Return 256 values, and for values of any shape the indices of the nearest ones, uint8."""
    table = table_of(values.reshape(-1), _TABLE)
    digits = [float(f"{value:.6g}") for value in table]  # More digits would be half of a small object's file.
    return digits, nearest(table, values).astype(np.uint8)


def _bands(rest: np.ndarray, images: dict[str, np.ndarray]) -> dict[str, Any]:
    count, coefficients = rest.shape[:2]
    palette, labels = palette_of(rest.reshape(count, -1))
    table, places = _in_table(palette.reshape(-1, coefficients, 3))
    grid = np.zeros((math.ceil(len(palette) / _ROW) * _ROW, coefficients, 3), np.uint8)
    grid[: len(palette)] = places
    images["shN_centroids.webp"] = grid.reshape(-1, _ROW * coefficients, 3)
    images["shN_labels.webp"] = _image(np.column_stack([labels & 255, labels >> 8, np.zeros_like(labels)]))
    return {
        "count": len(palette),
        "bands": math.isqrt(1 + coefficients) - 1,
        "codebook": table,
        "files": ["shN_centroids.webp", "shN_labels.webp"],
    }


def _image(pixels: np.ndarray) -> np.ndarray:
    """Return the rows of [N, channels] as an image [H, W, channels] uint8, nearly square, padded with 0."""
    width = 4 * math.ceil(math.sqrt(len(pixels)) / 4)
    height = math.ceil(len(pixels) / width)
    image = np.zeros((height * width, pixels.shape[1]), np.uint8)
    image[: len(pixels)] = pixels
    return image.reshape(height, width, -1)


def _zip(meta: dict[str, Any], images: dict[str, np.ndarray]) -> bytes:
    """Return an archive without times; images are stored uncompressed, because they do not shrink."""
    from PIL import Image

    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        for name, pixels in images.items():
            webp = io.BytesIO()
            # exact keeps the colours of transparent pixels; quality is the effort of lossless compression.
            Image.fromarray(pixels).save(webp, "WEBP", lossless=True, exact=True, quality=100, method=6)
            archive.writestr(zipfile.ZipInfo(name), webp.getvalue())
        archive.writestr(zipfile.ZipInfo("meta.json"), json.dumps(meta), zipfile.ZIP_DEFLATED)
    return content.getvalue()
