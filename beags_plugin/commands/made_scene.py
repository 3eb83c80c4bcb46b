"""What ``beags demo`` makes of photos before it trains: poses where there are none, masks where there are none."""

from __future__ import annotations

import json
from contextlib import nullcontext
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from rich.console import Console

from beags_plugin.commands.made_masks import MADE, check_source, made_masks
from beags_plugin.commands.process import find_poses
from beags_plugin.data.layout import fitting_layouts, read_dataset
from beags_plugin.posing.files import MODEL
from beags_plugin.posing.photos import check_photos, find_photos, with_masks
from beags_plugin.posing.process import NothingFits
from beags_plugin.posing.turned import move_otherwise, objects_seem_turned
from beags_plugin.posing.video import is_video
from beags_plugin.system.digests import content_digest, folder_digest
from beags_plugin.system.errors import UserError
from beags_plugin.system.progress import progress_bar
from beags_plugin.system.whole_files import write_text_atomically

CONSOLE = Console(soft_wrap=True, highlight=False, markup=False)  # paths may hold brackets
MADE_OF = "made_of.json"  # in the scene: the path of its photos
POSES = ("transforms*.json", "cameras.*", "*/cameras.*")  # of a scene that lacks something, not of photos alone


@dataclass(frozen=True)
class MadeScene:
    """A scene to train on: its folder, and the folder that holds masks/ and classes.json if it is another.

    turned: the objects turned while the room stood, and the poses are theirs.
    """

    data: Path
    labels: Path | None = None
    turned: bool = False

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
        check_source()
        return MadeScene(data, made_masks(data, output / "made"))
    found = [] if is_video(data) else find_photos(data)  # says what is wrong with them before anything is fetched
    given = data if any((data / "masks").rglob("*.png")) else None
    scene = output / "scene"
    _check_other(data, scene)
    if given is None:
        check_source()
    elif find_spec("pycolmap") is not None:  # else the next step says so
        with_masks(check_photos(found, scene / "images", progress_bar), given / "masks")
    CONSOLE.print(f"{data} has no poses, so they are computed from the photos.")
    own = None
    try:
        _print_poses(data, scene)
    except NothingFits as error:
        CONSOLE.print("The photos as a whole fit no poses, so poses of the objects alone are tried.")
        if (own := _scene_of_objects(scene, output / "turned", given)) is None:
            raise error
    if not (scene / MADE_OF).exists():
        write_text_atomically(json.dumps(str(data.resolve())), scene / MADE_OF)
    if own is not None:
        return own
    if given is not None and (scene / MADE).exists():
        (scene / "classes.json").unlink(missing_ok=True)  # of masks that were made when none were given
    labels = given or made_masks(scene, scene)
    if objects_seem_turned(scene / MODEL, (labels or scene) / "masks"):
        CONSOLE.print(
            "The poses explain few of the objects' features, as if the objects had turned before a room that stands: "
            "poses of the objects alone are tried."
        )
        own = _scene_of_objects(scene, output / "turned", given)
    return own or MadeScene(scene, labels)


def _print_poses(data: Path, scene: Path, masks: Path | None = None) -> None:
    for line in find_poses(data, scene, nullcontext(), masks):
        CONSOLE.print(line)


def _scene_of_objects(scene: Path, folder: Path, given: Path | None) -> MadeScene | None:
    """Make a scene in ``folder`` with poses from the objects' features alone.

    scene: with the photos, and with poses of the room if any fit. given: the folder that holds the user's masks/.
    Returns None, and says why, where the objects show too little for poses, or moved as the room did.
    """
    labels = given
    if labels is None:
        made_masks(scene / "images", labels := folder / "labels")  # of held-out photos too, for their poses
    try:
        _print_poses(scene / "images", folder, labels / "masks")
    except UserError as error:
        CONSOLE.print(f"There are none of the objects alone: {error}")
        return None
    if (scene / MODEL).exists() and not move_otherwise(folder / MODEL, scene / MODEL):
        CONSOLE.print(
            f"Those of the objects alone are alike, or are too few, so the poses in {scene} stay. If the objects did "
            "turn, take more photos of them or give masks of all that turned (in masks/ beside the photos)."
        )
        return None
    CONSOLE.print("The objects turned before a room that stands: poses and training are of the objects alone.")
    return MadeScene(folder, labels, turned=True)


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
