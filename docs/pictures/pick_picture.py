"""The picture of the tab Pick in docs/viewer.md: an object of a base cut out by one click, in a headless Chromium.

Run ``beags demo`` first; then ``python docs/pictures/pick_picture.py``. Another run or place of the click: ``--help``.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import tyro
from PIL import Image
from viewer_picture import Page, settled, viewed


@dataclass
class Picture:
    """The scene with an object in colour, and the tab Pick beside it."""

    load_config: Path = Path("outputs/demo/run/base/config.yml")
    """config.yml of a run; a base will do."""
    output: Path = Path("docs/images/pick.jpg")
    """The file."""
    click: tuple[int, int] = (497, 630)
    """Pixel of the window, across and down, on the object."""
    name: str = "ball"
    """What it is called."""
    width: int = 1280
    height: int = 900
    """Pixels of the window."""

    def write(self) -> None:
        with (
            tempfile.TemporaryDirectory() as folder,
            viewed(self.load_config.absolute(), Path(folder) / "log.txt") as address,
            Page(address, self.width, self.height) as page,
        ):
            page.open_tab("Pick")
            page.tick("Click to pick")
            page.write("Name", self.name)
            settled(page)
            page.click(*self.click)
            page.wait_for_text(" Gaussians (", 300)
            Image.fromarray(settled(page)).save(self.output, quality=85, optimize=True)


if __name__ == "__main__":
    tyro.cli(Picture).write()
