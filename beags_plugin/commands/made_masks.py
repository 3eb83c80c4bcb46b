"""Masks that ``beags demo`` makes where there are none: once, and never over what a user mended."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from beags_plugin.data.files import list_photos
from beags_plugin.data.layout import fitting_layouts
from beags_plugin.system.digests import folder_digest, value_digest
from beags_plugin.system.errors import UserError
from beags_plugin.system.whole_files import write_text_atomically

CONSOLE = Console(soft_wrap=True, highlight=False, markup=False)  # paths may hold brackets
SOURCE = "salient"  # of masks
MADE = "made.json"  # beside the masks: what they were made of, and what they were then
UNFINISHED = "unfinished"  # in MADE, while they are being made


def check_source() -> None:
    """Fetch the weights of the network; raises ``UserError`` where it cannot run."""
    from beags_plugin.masks.sources.salient import SalientSource, fetch_weights

    if reason := SalientSource.unavailable():
        raise UserError(f"there are no masks, and none can be made of what stands out: {reason}")
    fetch_weights()


def made_masks(scene: Path, folder: Path, name: str) -> Path | None:
    """Make the masks of a scene in ``folder``; return it, or None if it is the scene's.

    scene: or a folder of photos, without poses. name: of the object. What an earlier call made is taken as it is.
    """
    from beags_plugin.masks.sources.salient import SalientSource
    from beags_plugin.objects.make_masks import make_masks
    from beags_plugin.views.data_options import DataOptions
    from beags_plugin.views.scene_data import SceneData

    config = DataOptions(data=scene)
    images = SceneData(config).posed_views()[1].images if fitting_layouts(scene) else list_photos(scene)
    photos, masks = _digest(images), folder / "masks"
    made = _read_stamp(folder / MADE)
    there = any(masks.rglob("*.png")) and made.get("masks") != UNFINISHED
    if there and made.get("photos") != photos and made.get("masks") != folder_digest(masks):
        CONSOLE.print(f"The masks in {masks} are not as they were made, so they stay: delete them for new ones.")
    elif not there or made.get("photos") != photos:
        CONSOLE.print(
            f"{scene} has no masks, so a network marks what stands out in each photo, as one object "
            f"(beags masks make --source {SOURCE})."
        )
        folder.mkdir(parents=True, exist_ok=True)
        write_text_atomically(json.dumps({"masks": UNFINISHED}), folder / MADE)
        for line in make_masks(config, SalientSource(name=name), output=folder, overwrite=True):
            CONSOLE.print(line)
        write_text_atomically(json.dumps({"photos": photos, "masks": folder_digest(masks)}), folder / MADE)
    CONSOLE.print(f"Look at {folder / 'made.png'}. Masks in {masks} that you mend are taken by the next demo.")
    return None if folder == scene else folder


def as_made(folder: Path) -> bool:
    """Return whether the masks in a folder are those that the network made there, none of them mended."""
    made = _read_stamp(folder / MADE).get("masks")
    return made is not None and made != UNFINISHED and made == folder_digest(folder / "masks")


def _digest(photos: Sequence[Path]) -> str:
    """Digest name, size and time of photos."""
    return value_digest([[path.name, path.stat().st_size, path.stat().st_mtime_ns] for path in photos])


def _read_stamp(made: Path) -> dict[str, str]:
    try:
        content = json.loads(made.read_text())
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}
