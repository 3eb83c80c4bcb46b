"""The tabletop on a turntable: its objects turn, while ground, curtain and camera stand still."""

from __future__ import annotations

import numpy as np

from beags_plugin.sample.arrangement import make_still
from beags_plugin.sample.family import Family
from beags_plugin.sample.lighting import Light
from beags_plugin.sample.solids import turn_z, turned
from beags_plugin.sample.views import make_views


class TurntableLight(Light):
    """The light of the turning objects; the lamps turn with them, so that shading and shadows stay the same."""

    def _standing(self, points: np.ndarray, center: np.ndarray) -> np.ndarray:
        return turned(points, turn_z(float(np.arctan2(center[1], center[0]))))


TURNTABLE = Family(make_still, TurntableLight, make_views, turns=True)
