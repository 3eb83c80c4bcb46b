"""The families of generated scenes: each makes a scene, its light and its views from a seed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from beags_plugin.sample.arrangement import make_still
from beags_plugin.sample.desk import DeskLight, desk_views, make_desk
from beags_plugin.sample.lighting import Light, TurntableLight
from beags_plugin.sample.room import make_room, room_views
from beags_plugin.sample.room_light import RoomLight
from beags_plugin.sample.scene import Lighting, Scene
from beags_plugin.sample.views import View, make_views


@dataclass(frozen=True)
class Family:
    """Functions that make a family's scene of a seed, the light of such a scene, and its views as ``make_views``.

    turns: whether the background stands still with the camera while the objects turn.
    """

    scene: Callable[[int], Scene]
    light: Callable[[Any], Lighting]
    views: Callable[[int, int, int, int, int], list[View]]
    turns: bool = False


FAMILIES = {
    "tabletop": Family(make_still, Light, make_views),
    "turntable": Family(make_still, TurntableLight, make_views, turns=True),
    "room": Family(make_room, RoomLight, room_views),
    "desk": Family(make_desk, DeskLight, desk_views),
}
