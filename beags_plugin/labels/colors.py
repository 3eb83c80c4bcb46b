"""Colours of class ids, the same in every picture."""

from __future__ import annotations

import colorsys

import numpy as np

from beags_plugin.labels.class_ids import BACKGROUND, IGNORE, count_ids


def colorize(labels: np.ndarray) -> np.ndarray:
    """Return the colours of labels [H, W], [H, W, 3] uint8 RGB: the same for an id in all scenes.

    Background is black, IGNORE grey.
    """
    ids, _ = count_ids(np.asarray(labels))
    colors = np.zeros((int(ids.max(initial=0)) + 1, 3), np.uint8)
    for class_id in ids.tolist():
        colors[class_id] = _color(class_id)
    return colors.take(labels, axis=0)


def _color(class_id: int) -> tuple[int, int, int]:
    if class_id == BACKGROUND:
        return 0, 0, 0
    if class_id == IGNORE:
        return 128, 128, 128
    hue = class_id * 0.6180339887498949 % 1.0  # steps of the golden ratio keep neighbouring ids far apart
    value = (1.0, 0.8, 0.9)[class_id % 3]
    red, green, blue = colorsys.hsv_to_rgb(hue, 0.75, value)
    return round(255 * red), round(255 * green), round(255 * blue)
