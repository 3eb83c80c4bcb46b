"""Exposure and white balance that a camera chooses for each photo of one scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from beags_plugin.sample.degrade import view_generator
from beags_plugin.sample.scene import Lighting

LARGEST_STOPS = 6.0  # Photos beyond it are black or saturated.


def photo_gains(
    train: Sequence[str], held_out: Sequence[str], seed: int, exposure: float, white_balance: float
) -> dict[str, np.ndarray]:
    """Return the gains [3] of the linear red, green and blue of each photo relative to the mean exposure.

    train, held_out: names of the photos. exposure: stops, the largest difference of a photo from the mean.
    white_balance: stops, the largest additional difference of red, and of blue in the opposite direction. In log2 the
    mean over the training photos is 0, and the standard deviation about a third of the largest difference.
    """
    names = [*train, *held_out]
    stops = exposure * _lots(names, len(train), seed, 7)
    tint = white_balance * _lots(names, len(train), seed, 8)
    return dict(zip(names, np.exp2(np.stack([stops + tint, stops, stops - tint], axis=1)), strict=True))


def _lots(names: Sequence[str], num_train: int, seed: int, purpose: int) -> np.ndarray:
    """Return [N] numbers in -1..1 of standard deviation about 1/3; the mean of the first ``num_train`` is 0."""
    lots = np.array([view_generator(seed, name, purpose).normal(0.0, 1.0 / 3.0) for name in names])
    lots -= lots[:num_train].mean()
    # Training photos are scaled together, because clipping single ones would move the mean; held-out ones are clipped.
    return np.clip(lots / max(1.0, np.abs(lots[:num_train]).max()), -1.0, 1.0)


@dataclass(frozen=True)
class Exposed:
    """Light as one photo records it: that of the mean exposure times the gains [3] of the photo."""

    light: Lighting
    gains: np.ndarray

    def colours(
        self, points: np.ndarray, surface: np.ndarray, directions: np.ndarray, center: np.ndarray
    ) -> np.ndarray:
        return self.gains * self.light.colours(points, surface, directions, center)
