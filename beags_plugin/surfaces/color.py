"""Convert between sRGB, the values of photos, and linear light (IEC 61966-2-1)."""

from __future__ import annotations

import numpy as np


def linear_from_srgb(colors: np.ndarray) -> np.ndarray:
    """Return light intensities 0..1 of sRGB values 0..1, float64."""
    colors = np.clip(np.asarray(colors, dtype=np.float64), 0.0, 1.0)
    return np.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)


def srgb_from_linear(light: np.ndarray) -> np.ndarray:
    """Return sRGB values 0..1 of light intensities, which are clamped to 0..1; float64."""
    light = np.clip(np.asarray(light, dtype=np.float64), 0.0, 1.0)
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
