"""What ``beags demo`` makes of photos before it trains: poses where there are none, masks where there are none."""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from rich.console import Console

from beags_plugin.commands.process import find_poses
from beags_plugin.data.layout import fitting_layouts, read_dataset
from beags_plugin.posing.photos import check_photos, find_photos, with_masks
from beags_plugin.posing.video import is_video
from beags_plugin.system.digests import content_digest, folder_digest, value_digest
from beags_plugin.system.errors import UserError
from beags_plugin.system.progress import progress_bar
from beags_plugin.system.whole_files import write_text_atomically

CONSOLE = Console(soft_wrap=True, highlight=False, markup=False)  # paths may hold brackets
SOURCE = "salient"  # of masks
MADE_OF = "made_of.json"  # in the scene: the path of its photos
MADE = "made.json"  # beside the masks: what they were made of, and what they were then
POSES = ("transforms*.json", "cameras.*", "*/cameras.*")  # of a scene that lacks something, not of photos alone
UNFINISHED = "unfinished"  # in MADE, while they are being made


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

    def digests(self, output: Path) -> list[str]:
        """Digest the files of the scene, but what the demo wrote into ``output``, where that lies in the scene."""
        inside = self.data.resolve().is_relative_to(output.resolve())
        found = [folder_digest(self.data, without=None if inside else output)]
        if self.labels is not None:
            classes = self.labels / "classes.json"
            found += [folder_digest(self.labels / "masks"), content_digest([classes] if classes.exists() else [])]
        return found


def name_of(data: Path) -> str:
    """Return what the outputs of a scene, photos or a video are called; ``images`` alone would name nothing."""
    folder = data.resolve()
    return folder.stem if data.is_file() else folder.parent.name if folder.name == "images" else folder.name


def made_scene(data: Path, output: Path) -> MadeScene:
    """Return the scene in ``data``, or one made below ``output`` of photos without poses, or without masks.

    data: a scene, a folder of photos (or with images/, perhaps masks/), or a video. What an earlier call made of the
    same photos is taken as it is; masks also where the user has mended them. Raises ``UserError``; where masks cannot
    be made, before poses are computed.
    """
    if data.is_dir() and (fitting_layouts(data) or any(any(data.glob(pattern)) for pattern in POSES)):
        read_dataset(data)  # says what lacks or is too much
        if _has_masks(data):
            return MadeScene(data)
        _check_source()
        return MadeScene(data, _made_masks(data, output / "made"))
    found = [] if is_video(data) else find_photos(data)  # says what is wrong with them before anything is fetched
    given = data if any((data / "masks").rglob("*.png")) else None
    scene = output / "scene"
    _check_other(data, scene)
    if given is None:
        _check_source()
    elif find_spec("pycolmap") is not None:  # else the next step says so
        with_masks(check_photos(found, scene / "images", progress_bar), given / "masks")
    CONSOLE.print(f"{data} has no poses, so they are computed from the photos.")
    for line in find_poses(data, scene, nullcontext()):
        CONSOLE.print(line)
    if not (scene / MADE_OF).exists():
        write_text_atomically(json.dumps(str(data.resolve())), scene / MADE_OF)
    if given is not None and (scene / MADE).exists():
        (scene / "classes.json").unlink(missing_ok=True)  # of masks that were made when none were given
    return MadeScene(scene, given or _made_masks(scene, scene))


def _check_other(data: Path, scene: Path) -> None:
    """Raise ``UserError`` if a scene was made of other photos."""
    try:
        former = json.loads((scene / MADE_OF).read_text())
    except (OSError, ValueError):
        return
    if former != str(data.resolve()):
        raise UserError(f"{scene} was made of {former}: give another --output for {data}.")


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
