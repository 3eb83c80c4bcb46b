"""Masks that ``beags demo`` makes where there are none: once, and never over what a user mended."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

from rich.console import Console

from beags_plugin.data.files import list_photos
from beags_plugin.data.layout import fitting_layouts
from beags_plugin.masks.sources.base import MaskSource
from beags_plugin.system.digests import content_digest, folder_digest, value_digest
from beags_plugin.system.errors import UserError
from beags_plugin.system.pasted import command
from beags_plugin.system.whole_files import write_text_atomically

CONSOLE = Console(soft_wrap=True, highlight=False, markup=False)  # paths may hold brackets
MADE = "made.json"  # beside the masks: what they were made of, and what they were then
UNFINISHED = "unfinished"  # in MADE, while they are being made


@dataclass(frozen=True)
class ChosenSource:
    """The source of masks that the demo asks, and its options, as ``beags masks make`` takes them."""

    name: str = "salient"
    options: tuple[str, ...] = ()

    def below(self, data: Path) -> ChosenSource:
        """Return the source with files of its options found in ``data``, if they lie there."""
        found = []
        for key, equals, value in (option.partition("=") for option in self.options):
            found.append(f"{key}{equals}{data.absolute() / value if (data / value).is_file() else value}")
        return replace(self, options=tuple(found))

    def source(self, called: str = "") -> MaskSource:
        """Return the source; called: its one object's name, unless the options name it. Raises ``UserError``."""
        from beags_plugin.objects.make_masks import configured_source

        source = configured_source(self.name, self.options)
        if source.needs_run or not source.guesses:
            raise UserError(
                f"the demo cannot ask the mask source {self.name}, which needs a trained run or masks made elsewhere: "
                "make masks by beags masks make first, then run the demo on that scene."
            )
        nameless = called and hasattr(source, "name") and not any(each.startswith("name=") for each in self.options)
        return replace(source, name=called) if nameless else source  # pyright: ignore[reportArgumentType]

    def digest(self) -> str:
        """Digest the options, and the content of files that they name; empty for those that are the default."""
        if self == SALIENT:
            return ""
        source = self.source()
        values = [getattr(source, field.name) for field in fields(source)]  # pyright: ignore[reportArgumentType]
        files = [value for value in values if isinstance(value, Path) and value.is_file()]
        return value_digest([self.name, *(str(value) for value in values), content_digest(files)])

    def command(self, scene: Path) -> str:
        """Return the command that makes the same masks."""
        options = ["--options", *self.options] if self.options else []
        return command(["beags", "masks", "make", "--data", str(scene), "--source", self.name, *options])


SALIENT = ChosenSource()


def check_source(chosen: ChosenSource) -> None:
    """Fetch the weights of the default network; raises ``UserError`` where the source cannot run."""
    from beags_plugin.masks.sources.salient import SalientSource, fetch_weights

    if chosen != SALIENT:
        chosen.source().check()
        return
    if reason := SalientSource.unavailable():
        raise UserError(f"there are no masks, and none can be made of what stands out: {reason}")
    fetch_weights()


def made_masks(scene: Path, folder: Path, name: str, chosen: ChosenSource) -> Path | None:
    """Make the masks of a scene in ``folder``; return it, or None if it is the scene's.

    scene: or a folder of photos, without poses. name: of the object. What an earlier call made by the same source is
    taken as it is.
    """
    from beags_plugin.objects.make_masks import make_masks
    from beags_plugin.views.data_options import DataOptions
    from beags_plugin.views.scene_data import SceneData

    config = DataOptions(data=scene)
    images = SceneData(config).posed_views()[1].images if fitting_layouts(scene) else list_photos(scene)
    photos, masks = _digest(images), folder / "masks"
    photos = value_digest([photos, by]) if (by := chosen.digest()) else photos
    made = _read_stamp(folder / MADE)
    there = any(masks.rglob("*.png")) and made.get("masks") != UNFINISHED
    if there and made.get("photos") != photos and made.get("masks") != folder_digest(masks):
        CONSOLE.print(f"The masks in {masks} are not as they were made, so they stay: delete them for new ones.")
    elif not there or made.get("photos") != photos:
        CONSOLE.print(f"{scene} has no masks, so {_how(chosen)} ({chosen.command(scene)}).")
        folder.mkdir(parents=True, exist_ok=True)
        write_text_atomically(json.dumps({"masks": UNFINISHED}), folder / MADE)
        for line in make_masks(config, chosen.source(name), output=folder, overwrite=True):
            CONSOLE.print(line)
        write_text_atomically(json.dumps({"photos": photos, "masks": folder_digest(masks)}), folder / MADE)
    CONSOLE.print(f"Look at {folder / 'made.png'}. Masks in {masks} that you mend are taken by the next demo.")
    return None if folder == scene else folder


def _how(chosen: ChosenSource) -> str:
    one = chosen.name in ("salient", "rembg")
    return "a network marks what stands out in each photo, as one object" if one else "a network marks the objects"


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
