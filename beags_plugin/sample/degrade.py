"""Degrade masks like those of real segmenters: ragged boundaries, swapped pieces, missing masks.

The seed and the view's name decide everything, so one view's mask does not depend on the others.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from beags_plugin.sample.textures import Noise
from beags_plugin.system.errors import UserError, check_choice


@dataclass(frozen=True)
class Degradation:
    """Amounts of mask errors.

    rim: largest move of a boundary, over the image diagonal (0.0075 is 3 pixels at 320 x 240).
    dropped: share of the train views without a mask.
    swapped: probability, per object and view, that a piece of it has another id.
    """

    rim: float = 0.0
    dropped: float = 0.0
    swapped: float = 0.0


PRESETS = {
    "none": Degradation(),
    "mild": Degradation(rim=0.004, dropped=0.05, swapped=0.04),
    "strong": Degradation(rim=0.009, dropped=0.2, swapped=0.12),
}


def resolve_degradation(degradation: str | Degradation) -> Degradation:
    """Return the degradation of a preset's name, or a custom one; check its values."""
    if isinstance(degradation, str):
        check_choice(degradation, PRESETS, "mask degradation")
        return PRESETS[degradation]
    for name in ("rim", "dropped", "swapped"):
        value = getattr(degradation, name)
        if not 0.0 <= value <= 1.0:
            raise UserError(f"the mask degradation's {name} is {value}: give a number from 0 to 1.")
    return degradation


def view_generator(seed: int, view: str, purpose: int) -> np.random.Generator:
    """Return the generator of a view's random numbers for one purpose."""
    # Python's own string hash differs between runs; crc32 does not.
    return np.random.default_rng([seed, purpose, zlib.crc32(view.encode())])


def lowest_lots(names: Sequence[str], seed: int, count: int, purpose: int) -> set[str]:
    """Return the ``count`` names whose random number is lowest."""
    lots = sorted((float(view_generator(seed, name, purpose).random()), name) for name in names)
    return {name for _, name in lots[:count]}


def dropped_views(names: Sequence[str], seed: int, fraction: float) -> set[str]:
    """Return ``round(fraction * len(names))`` of the names, but never all, chosen by seed and name."""
    count = min(round(fraction * len(names)), len(names) - 1)
    return lowest_lots(names, seed, max(count, 0), 3)


def roughen_rims(labels: np.ndarray, amplitude: float, seed: int, view: str) -> np.ndarray:
    """Move every boundary by a smooth random displacement of at most ``amplitude`` pixels.

    labels: [H, W] ids. Returns the same shape and type. Each pixel takes the id at a displacement of smooth noise, so
    changes stay within ``amplitude`` + 0.71 pixels (the nearest pixel's centre) of a boundary.
    """
    if amplitude <= 0.0:
        return labels.copy()
    height, width = labels.shape
    noise = Noise(view_generator(seed, view, 4))
    y, x = np.meshgrid(np.arange(height) + 0.5, np.arange(width) + 0.5, indexing="ij")
    cell = max(3.0 * amplitude, 4.0)  # pixels per lattice cell; fewer than 4 would give isolated pixels
    points = np.stack([x.ravel() / cell, y.ravel() / cell, np.zeros(x.size)], axis=1)
    # Planes 10 lattice cells apart are independent; the noise is stretched, because middle values are most frequent.
    shift = [np.clip(3.0 * (noise(points + [0.0, 0.0, plane]) - 0.5), -1.0, 1.0) for plane in (0.0, 10.0)]
    length = np.maximum(np.hypot(shift[0], shift[1]), 1.0)
    dx, dy = (amplitude * (s / length).reshape(height, width) for s in shift)
    column = np.clip(np.floor(x + dx), 0, width - 1).astype(np.int64)
    row = np.clip(np.floor(y + dy), 0, height - 1).astype(np.int64)
    return labels[row, column]


def swap_pieces(labels: np.ndarray, num_classes: int, probability: float, seed: int, view: str) -> np.ndarray:
    """Return labels in which one connected piece of some objects has the id of another object or the background.

    labels: [H, W] ids in 0..num_classes - 1. Each object present is chosen with ``probability``; the piece is the
    largest connected part that a random line cuts off (15 to 60 percent of the visible object).
    """
    from scipy import ndimage

    out = labels.copy()
    generator = view_generator(seed, view, 5)
    for class_id in range(1, num_classes):
        # Absent objects take random numbers too, so that each object's swap does not depend on the others' presence.
        chance, angle, share, other = generator.random(4)
        rows, columns = np.nonzero(labels == class_id)
        if chance >= probability or len(rows) == 0:
            continue
        along = np.cos(2.0 * np.pi * angle) * columns + np.sin(2.0 * np.pi * angle) * rows
        cut = along <= np.quantile(along, 0.15 + 0.45 * share)
        part = np.zeros(labels.shape, dtype=bool)
        part[rows[cut], columns[cut]] = True
        pieces = np.asarray(ndimage.label(part)[0])  # type: ignore[index]
        piece = pieces == 1 + np.argmax(np.bincount(pieces.ravel())[1:])
        # Half of the pieces are lost to the background, the rest go to any other object.
        others = [i for i in range(1, num_classes) if i != class_id]
        out[piece] = 0 if other < 0.5 or not others else others[int((2.0 * other - 1.0) * len(others))]
    return out


def degrade_mask(labels: np.ndarray, num_classes: int, degradation: Degradation, seed: int, view: str) -> np.ndarray:
    """Swap pieces, then make boundaries ragged; ``dropped_views`` chooses the views without a mask.

    labels: [H, W] ids. Returns the same shape and type.
    """
    swapped = swap_pieces(labels, num_classes, degradation.swapped, seed, view)
    return roughen_rims(swapped, degradation.rim * math.hypot(*labels.shape), seed, view)
