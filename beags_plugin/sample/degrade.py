"""Degraded masks, as wrong as real ones: ragged boundaries, swapped pieces, views left out.

Everything is decided by the seed and the view's name, so one view's mask does not depend on the others.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from beags_plugin.sample.lots import lowest_lots, view_generator
from beags_plugin.sample.textures import Noise
from beags_plugin.system.errors import UserError, check_choice


@dataclass(frozen=True)
class Degradation:
    """Amounts by which masks are wrong.

    rim: farthest a boundary moves, as a fraction of the image diagonal (0.0075 is 3 pixels at 320 x 240).
    dropped: fraction of the train views that have no mask.
    swapped: probability, per object and view, that a piece of it carries another id.
    """

    rim: float = 0.0
    dropped: float = 0.0
    swapped: float = 0.0


PRESETS = {  # in the order of their degree: 0, 1, 2
    "none": Degradation(),
    "mild": Degradation(rim=0.004, dropped=0.05, swapped=0.04),
    "strong": Degradation(rim=0.009, dropped=0.2, swapped=0.12),
}


@dataclass(frozen=True)
class Swap:
    """A connected piece of ``pixels`` pixels of object ``class_id`` that was given ``new_id`` (0: background)."""

    class_id: int
    new_id: int
    pixels: int


def degradation_of_degree(degree: float) -> Degradation:
    """Interpolate the presets: degree 0 is "none", 1 "mild", 2 "strong", with straight lines between and beyond.

    Raises ``UserError`` for a degree below 0, or so high that a share would exceed 1.
    """
    if not 0.0 <= degree < math.inf:
        raise UserError(f"the degree of mask degradation is {degree}: give a number from 0 on (1 is mild, 2 strong).")
    steps = list(PRESETS.values())
    first = min(int(degree), len(steps) - 2)
    low, high, share = steps[first], steps[first + 1], degree - first
    values = (
        (1.0 - share) * getattr(low, name) + share * getattr(high, name) for name in ("rim", "dropped", "swapped")
    )
    return resolve_degradation(Degradation(*values))


def resolve_degradation(degradation: str | Degradation) -> Degradation:
    """Return a preset or a degree (a number) by name, or a custom one; raise ``UserError`` for an invalid one."""
    if isinstance(degradation, str):
        with suppress(ValueError):
            return degradation_of_degree(float(degradation))
        more = ", or a degree from 0 on (1 is mild, 2 strong)"
        check_choice(degradation, PRESETS, "mask degradation", more=more)
        return PRESETS[degradation]
    for name in ("rim", "dropped", "swapped"):
        value = getattr(degradation, name)
        if not 0.0 <= value <= 1.0:
            raise UserError(f"the mask degradation's {name} is {value}: give a number from 0 to 1.")
    return degradation


def dropped_views(names: Sequence[str], seed: int, fraction: float) -> set[str]:
    """Return the ``round(fraction * len(names))`` names, but never all, whose lot (by seed and name) is lowest."""
    count = min(round(fraction * len(names)), len(names) - 1)
    return lowest_lots(names, seed, max(count, 0), 3)


def rim_amplitude(strength: float, height: int, width: int) -> float:
    """Return the farthest displacement in pixels for a ``Degradation.rim`` in an image of this size."""
    return strength * math.hypot(height, width)


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
    cell = max(3.0 * amplitude, 4.0)  # pixels per lattice cell: at least 4, or the boundary turns to salt and pepper
    points = np.stack([x.ravel() / cell, y.ravel() / cell, np.zeros(x.size)], axis=1)
    # Planes 10 lattice cells apart are unrelated; the noise is stretched, as middle values are the most frequent.
    shift = [np.clip(3.0 * (noise(points + [0.0, 0.0, plane]) - 0.5), -1.0, 1.0) for plane in (0.0, 10.0)]
    length = np.maximum(np.hypot(shift[0], shift[1]), 1.0)
    dx, dy = (amplitude * (s / length).reshape(height, width) for s in shift)
    column = np.clip(np.floor(x + dx), 0, width - 1).astype(np.int64)
    row = np.clip(np.floor(y + dy), 0, height - 1).astype(np.int64)
    return labels[row, column]


def swap_pieces(
    labels: np.ndarray, num_classes: int, probability: float, seed: int, view: str
) -> tuple[np.ndarray, list[Swap]]:
    """Give one connected piece of some objects another object's id or the background's.

    labels: [H, W] ids in 0..num_classes - 1. Each object present is hit with ``probability``; the piece is the largest
    connected part of what a random line cuts off (15 to 60 percent of the visible object).
    Returns the new labels and what was done.
    """
    from scipy import ndimage

    out = labels.copy()
    swaps = []
    generator = view_generator(seed, view, 5)
    for class_id in range(1, num_classes):
        # Drawn for absent objects too, so that each object's fate does not depend on the others' presence.
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
        new_id = 0 if other < 0.5 or not others else others[int((2.0 * other - 1.0) * len(others))]
        out[piece] = new_id
        swaps.append(Swap(class_id, new_id, int(np.count_nonzero(piece))))
    return out, swaps


def degrade_mask(labels: np.ndarray, num_classes: int, degradation: Degradation, seed: int, view: str) -> np.ndarray:
    """Swap pieces, then make boundaries ragged; ``dropped_views`` leaves views out.

    labels: [H, W] ids. Returns the same shape and type.
    """
    swapped, _ = swap_pieces(labels, num_classes, degradation.swapped, seed, view)
    return roughen_rims(swapped, rim_amplitude(degradation.rim, *labels.shape), seed, view)
