"""Make the masks of ``beags demo`` where there are none: once, and never over masks that the user mended."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

from beags_plugin.commands.answers import CONSOLE, read_object
from beags_plugin.data.files import list_photos
from beags_plugin.data.layout import fitting_layouts
from beags_plugin.masks.sources.base import MaskSource
from beags_plugin.system.digests import content_digest, folder_digest, value_digest
from beags_plugin.system.errors import UserError
from beags_plugin.system.pasted import command
from beags_plugin.system.whole_files import write_text_atomically

MADE = "made.json"  # This file beside the masks holds digests of the photos, and of the masks as they were made.
UNFINISHED = "unfinished"  # MADE says this while the masks are being made.


@dataclass(frozen=True)
class ChosenSource:
    """The demo's source of masks and its options, as ``beags masks make`` takes them."""

    name: str = "salient"
    options: tuple[str, ...] = ()

    def below(self, data: Path) -> ChosenSource:
        """Return the source with absolute paths for options that name files in ``data``, also by default."""
        from beags_plugin.masks.sources import MASK_SOURCES

        options, named = [], {option.partition("=")[0] for option in self.options}
        for key, equals, value in (option.partition("=") for option in self.options):
            options.append(f"{key}{equals}{data.absolute() / value if (data / value).is_file() else value}")
        for field in fields(MASK_SOURCES.get(self.name)):
            usual = field.default
            if field.name not in named and isinstance(usual, Path) and (data / usual).is_file():
                options.append(f"{field.name}={data.absolute() / usual}")
        return replace(self, options=tuple(options))

    def source(self, called: str = "") -> MaskSource:
        """Return the source; called: name of its one object if no option names it. Raises ``UserError``."""
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
        """Return a digest of the options and the files that they name; empty for ``SALIENT``."""
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
        raise UserError(f"there are no masks, and the source salient cannot make any: {reason}")
    fetch_weights()


def made_masks(scene: Path, folder: Path, name: str, chosen: ChosenSource) -> Path | None:
    """Make the masks of a scene in ``folder``; return ``folder``, or None if it is the scene's own.

    scene: its folder, or one of photos without poses. name: of the object. Masks that the same source made of the same
    photos are used again.
    """
    from beags_plugin.objects.make_masks import make_masks
    from beags_plugin.views.data_options import DataOptions
    from beags_plugin.views.scene_data import SceneData

    config = DataOptions(data=scene)
    images = SceneData(config).posed_views()[1].images if fitting_layouts(scene) else list_photos(scene)
    photos, masks = _digest(images), folder / "masks"
    photos = value_digest([photos, by]) if (by := chosen.digest()) else photos
    made = read_object(folder / MADE)
    exist = any(masks.rglob("*.png")) and made.get("masks") != UNFINISHED
    if exist and made.get("photos") != photos and made.get("masks") != folder_digest(masks):
        CONSOLE.print(f"The masks in {masks} were mended, so they stay: delete them for new ones.")
    elif not exist or made.get("photos") != photos:
        single = chosen.name in ("salient", "rembg")
        marks = "what stands out in each photo, as one object" if single else "the objects"
        CONSOLE.print(f"{scene} has no masks, so a network marks {marks} ({chosen.command(scene)}).")
        folder.mkdir(parents=True, exist_ok=True)
        write_text_atomically(json.dumps({"masks": UNFINISHED}), folder / MADE)
        for line in make_masks(config, chosen.source(name), output=folder, overwrite=True):
            CONSOLE.print(line)
        made = {"photos": photos, "masks": folder_digest(masks), "files": _files(masks)}
        write_text_atomically(json.dumps(made), folder / MADE)
    CONSOLE.print(f"Look at {folder / 'made.png'}. If you mend masks in {masks}, the next demo uses them.")
    return None if folder == scene else folder


def as_made(folder: Path) -> bool:
    """Return whether each mask in a folder is as the network made it; the user may have deleted others."""
    made = read_object(folder / MADE)
    if made.get("masks") in (None, UNFINISHED):
        return False
    return _files(folder / "masks").items() <= made.get("files", {}).items()


def mended(folder: Path) -> bool:
    """Return whether a network made masks in a folder, and the user changed or added some."""
    return (folder / MADE).exists() and not as_made(folder)


def _files(masks: Path) -> dict[str, str]:
    """Return the digest of each mask by its name."""
    return {str(path.relative_to(masks)): content_digest([path]) for path in sorted(masks.rglob("*.png"))}


def _digest(photos: Sequence[Path]) -> str:
    """Digest name, size and time of photos."""
    return value_digest([[path.name, path.stat().st_size, path.stat().st_mtime_ns] for path in photos])
