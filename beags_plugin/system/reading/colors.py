"""Colours of points as bytes, from any of the number ranges that programs write."""

from __future__ import annotations

import numpy as np

GREY = 128
SH_BAND_0 = 0.28209479177387814  # constant spherical harmonic: a 3DGS colour is 0.5 + this times f_dc
_MOST = 0.99  # share of the numbers that decide on the range; a few may lie outside it
_NAMES = (
    ("red", "green", "blue"),
    ("diffuse_red", "diffuse_green", "diffuse_blue"),
    ("r", "g", "b"),
    ("scalar_red", "scalar_green", "scalar_blue"),
)


def colors_of(table: np.ndarray) -> np.ndarray:
    """Return the colours [N, 3] uint8 of points in a structured array; mid-grey if it has none that can be read.

    The columns are red, green, blue, their other names in ``_NAMES``, or f_dc_0..2 of splats; see ``as_bytes``.
    """
    columns = {name.casefold(): name for name in table.dtype.names or ()}
    for names in _NAMES:
        if all(name in columns for name in names):
            return as_bytes(np.stack([table[columns[name]] for name in names], axis=1))
    bands = [f"f_dc_{index}" for index in range(3)]
    if all(name in columns for name in bands):
        shares = 0.5 + SH_BAND_0 * np.stack([table[columns[name]].astype(np.float64) for name in bands], axis=1)
        return as_bytes(np.clip(np.nan_to_num(shares, nan=0.5), 0.0, 1.0))
    return np.full((len(table), 3), GREY, np.uint8)


def as_bytes(colors: np.ndarray) -> np.ndarray:
    """Return colours [N, 3] of any type as uint8; type and range decide on the scale, as in viewers.

    One-byte integers are bytes. Wider integers up to 255 are bytes, larger ones 16 bits. Floats are shares of 1, bytes
    up to 255, or 16 bits. A colour that is no number is mid-grey; so are all if the numbers fit none of these ranges.
    """
    if colors.dtype.itemsize == 1:
        return np.ascontiguousarray(colors).view(np.uint8).reshape(colors.shape)
    values, most = range_of(colors)
    if most is None:
        return np.full(values.shape, GREY, np.uint8)
    finite = np.isfinite(values).all(axis=1)
    scaled = np.clip(np.where(finite[:, None], values, GREY / 255.0 * most) * (255.0 / most) + 0.5, 0, 255)
    return scaled.astype(np.uint8)


def range_of(colors: np.ndarray) -> tuple[np.ndarray, float | None]:
    """Return colours [N, C] as float64, and the number that stands for 1 (None without a range, see ``as_bytes``)."""
    whole = colors.dtype.kind in "iu"
    values = (colors.view(np.uint8) if colors.dtype.kind == "i" and colors.dtype.itemsize == 1 else colors).astype(
        np.float64
    )
    if colors.dtype.itemsize == 1:
        return values, 255.0
    if whole and colors.dtype.itemsize == 2:
        values[values < 0] += 65536  # 16 bits whose type should be unsigned
    finite = np.isfinite(values).all(axis=1)
    if not finite.any():
        return values, None
    least, most = np.quantile(values[finite], [1.0 - _MOST, _MOST])
    highest = values[finite].max()
    if not whole and least >= -0.05 and most <= 1.05:
        return values, 1.0
    if least >= (0.0 if whole else -1.0) and (highest <= 255.0 or (not whole and most <= 256.0)):
        return values, 255.0
    return values, 65535.0 if least >= 0.0 and most <= 65535.0 else None
