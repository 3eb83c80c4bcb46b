"""The cameras of a room: three passes along an arc in front of the table."""

from __future__ import annotations

import numpy as np

from beags_plugin.sample.room import Shell
from beags_plugin.sample.views import View, held_out, look_at, make_view

ARC = 1.85
"""Radians to either side of the table's front where photos are taken."""
ELEVATIONS = (0.24, 0.50, 0.80)
TARGET = np.array([0.0, 0.0, 0.14])


def room_views(seed: int, width: int, height: int, num_train: int, num_test: int) -> list[View]:
    """Make the passes; every fourth test view lies beyond the arc's ends and shows what photos hardly show."""
    generator = np.random.default_rng([seed, 2])
    turn = Shell.of(seed).turn
    total, tests = num_train + num_test, held_out(num_train, num_test)
    beyond = tests[2::4]
    views = []
    for i in range(total):
        progress = i * len(ELEVATIONS) / total
        level = int(progress)
        along = (2.0 * (progress - level) - 1.0) * (-1.0) ** level * ARC  # there, back, and there again
        spread = generator.uniform(-1.0, 1.0, 7)
        if i in beyond:
            along = np.copysign(ARC + 0.25 + 0.12 * spread[0], along)
        azimuth = along + 0.05 * spread[0] - 0.5 * np.pi
        elevation = ELEVATIONS[level] + 0.06 * spread[1]
        way = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
        target = TARGET + 0.12 * spread[2:5] * [1.0, 1.0, 0.5]
        place = target + 2.15 * (1.0 + 0.08 * spread[5]) * way
        pose = look_at(turn @ place, turn @ target, 0.04 * spread[6])
        views.append(make_view(i, i in tests, pose, 0.98, width, height))
    return views
