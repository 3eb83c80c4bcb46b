"""Make the pictures of docs/photos.md from ``beags demo --data outputs/walk.mp4``, the video of ``walk_video.py``.

``python docs/pictures/photos_page.py [--demo outputs/walk]``
"""

from __future__ import annotations

from pathlib import Path

import tyro
from PIL import Image

WIDTH = 1000  # pixels at most
PARTS = {  # picture to file of the demo and the upper share of its height that is shown
    "poses": ("scene/poses.png", 1.0),
    "made": ("scene/made.png", 0.4),
    "contradicted": ("scene/contradicted.png", 0.33),
    "sheet": ("contact_sheet.png", 1.0),
}


def main(demo: Path = Path("outputs/walk"), output: Path = Path("docs/images")) -> None:
    """Cut and reduce the pictures of a demo.

    demo: its folder. output: the folder for photos_*.jpg.
    """
    for name, (file, share) in PARTS.items():
        picture = Image.open(demo / file).convert("RGB")
        picture = picture.crop((0, 0, picture.width, round(share * picture.height)))
        picture.thumbnail((WIDTH, 10 * WIDTH))
        picture.save(output / f"photos_{name}.jpg", quality=82)


if __name__ == "__main__":
    tyro.cli(main)
