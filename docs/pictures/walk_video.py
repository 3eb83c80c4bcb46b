"""Write a generated video for docs/photos.md: somebody walks around a thing on the table of a generated room.

``python docs/pictures/walk_video.py [--output walk.mp4]``, about five minutes of one core; then ``beags demo --data``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import av
import numpy as np
import tyro

from beags_benchmarks.samples.room import TracedLight, make_room
from beags_plugin.sample.views import View, look_at, render_image
from beags_plugin.system.progress import counted, progress_bar

LENS = 1.0  # focal length over width
RADII, HEIGHTS = (1.25, 1.0), (0.45, 0.85)  # world units, for each of the two rounds about the thing


@dataclass
class Walk:
    """Two rounds about some objects of a room, which are moved to the middle of the table."""

    output: Path = Path("outputs/walk.mp4")
    """The video."""
    seed: int = 1
    """Seed of the room."""
    thing: tuple[str, ...] = ("basket", "ball")
    """Names of the objects that stay."""
    frames: int = 110
    """Frames of the video."""
    width: int = 480
    """Pixels; the height is three quarters of it."""

    def write(self) -> None:
        room = make_room(self.seed)
        things = [thing for thing in room.things if thing.name in self.thing]
        middle = np.array([*things[0].position[:2], 0.0])
        room = replace(room, things=tuple(replace(one, position=one.position - middle) for one in things), contacts=())
        light, height = TracedLight(room), 3 * self.width // 4
        self.output.parent.mkdir(parents=True, exist_ok=True)
        with progress_bar("Filming") as progress, av.open(str(self.output), "w") as container:
            stream = container.add_stream("h264", rate=10, options={"crf": "16"})
            stream.width, stream.height, stream.pix_fmt = self.width, height, "yuv420p"
            for pose in counted(self.poses(), self.frames, progress):
                view = View("", "train", pose, LENS * self.width, self.width / 2, height / 2, self.width, height)
                image = render_image(room, light, view, 2)
                container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
            container.mux(stream.encode())

    def poses(self) -> list[np.ndarray]:
        """Return the camera of each frame, as a hand holds it."""
        generator, target, poses = np.random.default_rng(self.seed), np.array([0.0, 0.0, 0.12]), []
        for share in np.linspace(0.0, 2.0, self.frames, endpoint=False):
            angle, second = 2.0 * np.pi * share, int(share)
            place = [RADII[second] * np.cos(angle), RADII[second] * np.sin(angle), HEIGHTS[second]]
            poses.append(look_at(np.array(place), target + generator.normal(0.0, 0.01, 3), generator.normal(0.0, 0.02)))
        return poses


if __name__ == "__main__":
    tyro.cli(Walk).write()
