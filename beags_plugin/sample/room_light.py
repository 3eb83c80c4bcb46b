"""Light of a room: a bright panel in the ceiling with soft shadows, and light reflected by the walls."""

from __future__ import annotations

import numpy as np

from beags_plugin.sample.meshes import block, moved, raycaster, rays
from beags_plugin.sample.room import Room
from beags_plugin.sample.solids import dot, turned

LIFT = 1e-3  # distance from the surface at which shadow rays start, so that they do not hit it; world units
PANEL = np.array([1.1, 0.7])  # half the sides of the panel
LAMP, BOUNCE = np.array([9.5, 9.1, 8.4]), np.array([0.40, 0.39, 0.41])
REACH = 0.8  # distance within which surfaces block reflected light from one another, world units
SHARES = 4
"""Each ray of a pixel samples one of so many shares of the lamp and of the directions; together they sample all."""


def _spiral(count: int) -> np.ndarray:
    """Return [count, 3] unit vectors, spread evenly."""
    z = 1.0 - 2.0 * (np.arange(count) + 0.5) / count
    angle = 2.399963 * np.arange(count)
    return np.stack([np.sqrt(1.0 - z * z) * np.cos(angle), np.sqrt(1.0 - z * z) * np.sin(angle), z], axis=1)


class RoomLight:
    """Measure the light at points of a room."""

    def __init__(self, room: Room, lamp_samples: int = 24, bounce_samples: int = 16) -> None:
        self.room = room
        parts = [
            (turned(thing.solid.vertices, thing.rotation.T) + thing.position, thing.solid.triangles)
            for thing in (*room.things, *room.fixtures)
        ]
        shell = room.shell
        box = moved(block(shell.half[0], shell.half[1], -shell.half[2], shell.half[2]), tuple(shell.middle))
        self._blockers = raycaster([*parts, (turned(box[0], shell.turn.T), box[1])])
        steps = (np.arange(lamp_samples) + 0.5) / lamp_samples, np.arange(lamp_samples) * 0.618034 % 1.0
        panel = (2.0 * np.stack(steps, axis=1) - 1.0) * PANEL
        height = shell.middle[2] + shell.half[2] - 10.0 * LIFT
        self._lamp = turned(np.column_stack([panel, np.full(lamp_samples, height)]), shell.turn.T)
        self._ways = _spiral(bounce_samples)

    def _open(self, points: np.ndarray, ways: np.ndarray, end: float) -> np.ndarray:
        return ~self._blockers.test_occlusions(rays(points, ways), 0.0, end).numpy()

    def light_at(self, points: np.ndarray, normals: np.ndarray, share: np.ndarray) -> np.ndarray:
        """Return [N, 3] light at surface points [N, 3] with normals [N, 3], from the samples of each one's share."""
        lifted = points + LIFT * normals
        direct, bounced = np.zeros(len(points)), np.zeros(len(points))
        members = [np.flatnonzero(share == i) for i in range(SHARES)]
        for i, place in enumerate(self._lamp):
            on = members[i % SHARES]
            way = place - lifted[on]
            squared = dot(way, way)
            facing = np.maximum(dot(way, normals[on]), 0.0) * np.maximum(way[:, 2], 0.0) / squared**2
            lit = np.flatnonzero(facing > 0.0)
            direct[on[lit]] += facing[lit] * self._open(lifted[on[lit]], way[lit], 1.0)
        for i, way in enumerate(self._ways):  # normal + way has a density proportional to the cosine.
            on = members[i % SHARES]
            bounced[on] += self._open(lifted[on], normals[on] + 0.999 * way, REACH)
        direct *= SHARES / len(self._lamp)
        bounced = 0.25 + 0.75 * SHARES / len(self._ways) * bounced
        return direct[:, None] * LAMP + bounced[:, None] * BOUNCE

    def paper(self, local: np.ndarray) -> np.ndarray:
        """Return the shell's albedo at points [N, 3] in its frame; that of the panel is 10, so that it is white."""
        shell = self.room.shell
        ceiling = (np.argmax(np.abs(local) / shell.half, axis=1) == 2) & (local[:, 2] > 0.0)
        panel = ceiling & (np.abs(local[:, :2] + shell.middle[:2]) < PANEL).all(axis=1)
        return np.where(panel[:, None], 10.0, self.room.walls(local))
