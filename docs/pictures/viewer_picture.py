"""The picture of docs/viewer.md: nerfstudio's viewer with our panel, of a run, in a headless Chromium.

Run ``beags demo`` first; then ``python docs/pictures/viewer_picture.py``. Another run or object: ``--help``. It opens
what the tests of the viewer open (viewer_pages.py and browser.py in tests/support/), so Chromium must be there.
"""

from __future__ import annotations

import sys
import tempfile
import time
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
import tyro
from PIL import Image

sys.path.append(str(Path(__file__).parents[2] / "tests/support"))

from browser import Page  # noqa: E402
from viewer_pages import viewed  # noqa: E402

from beags_plugin.runs.run import Run  # noqa: E402
from beags_plugin.system.errors import UserError  # noqa: E402


@dataclass
class Picture:
    """The scene beside its class map, and the panel with an object chosen."""

    load_config: Path = Path("outputs/demo/run/config.yml")
    """config.yml of a refined run."""
    output: Path = Path("docs/images/viewer.jpg")
    """The file."""
    object: str = "mug"
    """Name of the object that the panel's buttons are about."""
    width: int = 1280
    height: int = 900
    """Pixels of the window."""

    def write(self) -> None:
        scene = Run(self.load_config).assigned
        if self.object not in scene.classes.values():
            raise UserError(f"{self.load_config} has no object {self.object!r}.")
        with (
            tempfile.TemporaryDirectory() as folder,
            viewed(self.load_config.absolute(), Path(folder) / "log.txt") as address,
            Page(address, self.width, self.height) as page,
        ):
            page.wait_for_text("Export what is shown", 300)
            page.tick("Enable")  # the split screen's: the first of that name
            page.wait_for_text("Output render split")
            page.choose("Output render split", "class_map")
            page.choose("Object", self.object)
            Image.fromarray(settled(page)).save(self.output, quality=85, optimize=True)


def settled(page: Page) -> np.ndarray:
    """Return the page's picture once it has not changed for 15 seconds; coarse pictures come before fine ones."""
    picture, since = _pixels(page), time.monotonic()

    def still() -> bool:
        nonlocal picture, since
        now = _pixels(page)
        if not np.array_equal(now, picture):
            picture, since = now, time.monotonic()
        return time.monotonic() - since > 15.0

    page.wait(still, 300)
    return picture


def _pixels(page: Page) -> np.ndarray:
    return np.asarray(Image.open(BytesIO(page.picture())).convert("RGB"))


if __name__ == "__main__":
    tyro.cli(Picture).write()
