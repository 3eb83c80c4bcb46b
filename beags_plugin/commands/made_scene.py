"""What ``beags demo`` makes of photos before it trains: poses where there are none, masks where there are none."""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from beags_plugin.commands.process import find_poses
from beags_plugin.data.layout import fitting_layouts
from beags_plugin.posing.photos import find_photos
from beags_plugin.posing.video import is_video
from beags_plugin.system.digests import folder_digest, value_digest
from beags_plugin.system.errors import UserError
from beags_plugin.system.whole_files import write_text_atomically

CONSOLE = Console(soft_wrap=True, highlight=False, markup=False)  # paths may hold brackets
SOURCE = "salient"  # of masks
MADE = "made.json"  # beside the masks: what they were made of, and what they were then


@dataclass(frozen=True)
class MadeScene:
    """A scene to train on: its folder, and the folder that holds masks/ and classes.json if it is another."""

    data: Path
    labels: Path | None = None

    def options(self) -> list[str]:
        """Return the options of ``beags-data`` that name its masks."""
        if self.labels is None:
            return []
        masks, classes = self.labels.absolute() / "masks", self.labels.absolute() / "classes.json"
        return ["--masks-path", str(masks), *(["--classes-path", str(classes)] if classes.exists() else [])]


def made_scene(data: Path, output: Path) -> MadeScene:
    """Return the scene in ``data``, or one made below ``output`` of photos without poses, or without masks.

    data: a scene, a folder of photos (or with images/, perhaps masks/), or a video. What an earlier call made of the
    same photos is taken as it is; masks also where the user has mended them. Raises ``UserError``; where masks cannot
    be made, before poses are computed.
    """
    if data.is_dir() and fitting_layouts(data):
        if _has_masks(data):
            return MadeScene(data)
        _check_source()
        return MadeScene(data, _made_masks(data, output / "made"))
    if not is_video(data):
        find_photos(data)  # says what is wrong with them before anything is fetched
    given = data if any((data / "masks").rglob("*.png")) else None
    if given is None:
        _check_source()
    scene = output / "scene"
    CONSOLE.print(f"{data} has no poses, so they are computed from the photos.")
    for line in find_poses(data, scene, nullcontext()):
        CONSOLE.print(line)
    return MadeScene(scene, given or _made_masks(scene, scene))


def _has_masks(data: Path) -> bool:
    from beags_plugin.plugin.views.dataparser import BeagsDataParser, BeagsDataParserConfig

    parser: BeagsDataParser = BeagsDataParserConfig(data=data).setup()
    masks, folder, _ = parser.mask_files(*parser.posed_views())
    return any(masks) or any(folder.glob("**/*.png"))  # training says what is wrong with their names


def _check_source() -> None:
    """Fetch the weights of the network; raises ``UserError`` where it cannot run."""
    from beags_plugin.masks.sources.salient import SalientSource, fetch_weights

    if reason := SalientSource.unavailable():
        raise UserError(f"there are no masks, and none can be made of what stands out: {reason}")
    fetch_weights()


def _made_masks(scene: Path, folder: Path) -> Path | None:
    """Make the masks of a scene in ``folder``; return it, or None if it is the scene's."""
    from beags_plugin.masks.sources.salient import SalientSource
    from beags_plugin.plugin.objects.make_masks import make_masks
    from beags_plugin.plugin.views.dataparser import BeagsDataParserConfig

    config = BeagsDataParserConfig(data=scene)
    photos, masks = _digest(config.setup().posed_views()[1].images), folder / "masks"
    made = _read(folder / MADE)
    there = any(masks.rglob("*.png"))
    if there and made.get("photos") != photos and made.get("masks") != folder_digest(masks):
        CONSOLE.print(f"The masks in {masks} are not as they were made, so they stay: delete them for new ones.")
    elif not there or made.get("photos") != photos:
        CONSOLE.print(
            f"{scene} has no masks, so a network marks what stands out in each photo, as one object "
            f"(beags masks make --source {SOURCE})."
        )
        for line in make_masks(config, SalientSource(), output=folder, overwrite=True):
            CONSOLE.print(line)
        write_text_atomically(json.dumps({"photos": photos, "masks": folder_digest(masks)}), folder / MADE)
    CONSOLE.print(f"Look at {folder / 'made.png'}. Masks in {masks} that you mend are taken by the next demo.")
    return None if folder == scene else folder


def _digest(photos: Sequence[Path]) -> str:
    """Digest name, size and time of photos."""
    return value_digest([[path.name, path.stat().st_size, path.stat().st_mtime_ns] for path in photos])


def _read(made: Path) -> dict[str, str]:
    try:
        content = json.loads(made.read_text())
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}
