"""Options for pictures of objects."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from beags_plugin.system.errors import UserError, check_choice

PictureFormat = Literal["video", "sheet", "before-after"]
Background = Literal["white", "black", "checker"]


@dataclass(frozen=True)
class RenderOptions:
    """How the pictures are rendered."""

    camera_path: Path | None = None
    """A file that the viewer's tab Render has saved: a video along it, of its size and frames per second. Without
    --object it shows the whole scene."""
    size: int | None = None
    """Pixels along each side of one picture; 480 in a video, 232 in a sheet, 400 before and after."""
    frames: int = 120
    """Frames of a turn in a video."""
    views: int = 8
    """Pictures of a turn in a sheet (before-after: half as many)."""
    fps: int = 30
    """Frames of a video per second."""
    elevation: float = 20.0
    """Elevation of the camera above the horizon, degrees."""
    turn: float = 360.0
    """Degrees of the turn; less than 360 swings to and fro before the side that the photos show."""
    background: Background = "white"
    """What is behind the object: white, black, or checker."""

    def check(self) -> None:
        """Raise ``UserError`` for a value that cannot be used."""
        check_choice(self.background, get_args(Background), "background")
        if self.camera_path is not None and not self.camera_path.is_file():
            raise UserError(f"there is no camera path {self.camera_path}: save one in the tab Render of ns-viewer.")
        for name, lowest, highest in (("frames", 1, 10_000), ("views", 1, 360), ("fps", 1, 240)):
            if not lowest <= (value := getattr(self, name)) <= highest:
                raise UserError(f"{name} is {value}: give a number from {lowest} to {highest}.")
        if self.size is not None and not 16 <= self.size <= 4096:
            raise UserError(f"size is {self.size}: give pixels from 16 to 4096.")
        if not -90.0 <= self.elevation <= 90.0:
            raise UserError(f"elevation is {self.elevation}: give degrees from -90 to 90.")
        if not 0.0 < self.turn <= 360.0:
            raise UserError(f"turn is {self.turn}: give degrees above 0, 360 at most.")
