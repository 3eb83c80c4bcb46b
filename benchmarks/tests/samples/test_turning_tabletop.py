"""The turntable: objects as on the tabletop, and a room that stands still with the camera."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from beags_plugin.sample import FAMILIES
from beags_plugin.sample.solids import turn_z
from beags_plugin.sample.views import render_view


def test_on_a_turntable_objects_look_the_same_and_the_room_stands():
    """Objects look as on the tabletop, and two cameras on a circle see the same picture of the room."""
    table, still = FAMILIES.get("turntable"), FAMILIES.get("tabletop")
    made = table.scene(0)
    views = table.views(0, 96, 72, 6, 1)
    turn = np.eye(4)
    turn[:3, :3] = turn_z(1.0)
    for view in views[:2]:
        turned = replace(view, camera_to_world=turn @ view.camera_to_world)
        found = {}
        for name, family in (("still", still), ("turning", table)):
            light = family.light(made)
            found[name] = [render_view(made, light, each, 1) for each in (view, turned)]
        one, other = found["turning"]
        assert np.array_equal(one.labels, found["still"][0].labels)
        objects = one.labels > 0
        assert np.array_equal(one.image[objects], found["still"][0].image[objects])
        room = ~objects & (other.labels == 0)
        differs = {name: np.abs(np.float64(a.image) - b.image)[room].mean() for name, (a, b) in found.items()}
        assert differs["turning"] < 8 < 16 < differs["still"], differs  # shadows turn
