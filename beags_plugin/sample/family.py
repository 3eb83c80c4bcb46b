"""A family of generated scenes: functions that make a scene, its light and its views from a seed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from beags_plugin.sample.scene import Lighting, Scene
from beags_plugin.sample.views import View


@dataclass(frozen=True)
class Family:
    """Functions that make a family's scene of a seed, the light of such a scene, and its views as ``make_views``.

    turns: whether the background stands still with the camera while the objects turn.
    """

    scene: Callable[[int], Scene]
    light: Callable[[Any], Lighting]
    views: Callable[[int, int, int, int, int], list[View]]
    turns: bool = False
