"""Make the scene of ``beags demo`` from photos: poses where there are none, masks where there are none."""

from __future__ import annotations

import json
import shutil
from contextlib import nullcontext
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from beags_plugin.commands.answers import CONSOLE
from beags_plugin.commands.made_masks import MADE, SALIENT, ChosenSource, as_made, check_source, made_masks, mended
from beags_plugin.commands.process import find_poses
from beags_plugin.data.layout import fitting_layouts, read_dataset
from beags_plugin.masks.sources.base import NothingFound
from beags_plugin.posing.files import MODEL
from beags_plugin.posing.photos import check_photos, find_photos, with_masks
from beags_plugin.posing.process import REPORT, NothingFits
from beags_plugin.posing.turned import ENOUGH, objects_seem_turned, poses_are_their_own
from beags_plugin.posing.video import is_video
from beags_plugin.system.digests import content_digest, folder_digest
from beags_plugin.system.errors import UserError
from beags_plugin.system.memory import trim_memory
from beags_plugin.system.progress import progress_bar
from beags_plugin.system.whole_files import write_text_atomically

MADE_OF = "made_of.json"  # This file in the scene holds the path of its photos.
POSES = ("transforms*.json", "cameras.*", "*/cameras.*")  # Files that only a scene has, even an incomplete one.


@dataclass(frozen=True)
class MadeScene:
    """A scene to train on.

    data: its folder. labels: the folder with masks/ and classes.json, if it is another one. turned: whether the objects
    turned while the room stood still, and the poses are those of the objects. without: stems of photos with wrong
    poses, which are not used.
    """

    data: Path
    labels: Path | None = None
    turned: bool = False
    without: tuple[str, ...] = ()

    @property
    def made_masks(self) -> Path | None:
        """Return the folder of masks that a network made and nobody repainted; None for others."""
        folder = self.labels or self.data
        return folder / "masks" if as_made(folder) else None

    @property
    def mended(self) -> bool:
        """Return whether a network made masks and the user repainted some, so that all are taken as they are."""
        return mended(self.labels or self.data)

    def options(self) -> list[str]:
        """Return the options of ``beags-data`` that name its masks, and photos that are not used."""
        left_out = ["--leave-out", *self.without] if self.without else []
        if self.labels is None:
            return left_out
        masks, classes = self.mask_paths()
        named = ["--classes-path", str(classes)] if classes.exists() else []
        return [*left_out, "--masks-path", str(masks), *named]

    def mask_paths(self) -> tuple[Path, Path]:
        """Return the folder of its masks, and the file of their classes, which may be missing."""
        folder = (self.labels or self.data).absolute()
        return folder / "masks", folder / "classes.json"

    def digests(self, output: Path) -> list[str]:
        """Return digests of the scene's files, without those that the demo wrote into ``output`` inside the scene."""
        inside = self.data.resolve().is_relative_to(output.resolve())
        digests = [folder_digest(self.data, without=None if inside else output)]
        if self.labels is not None:
            classes = self.labels / "classes.json"
            digests += [folder_digest(self.labels / "masks"), content_digest([classes] if classes.exists() else [])]
        return digests


def name_of(data: Path) -> str:
    """Return the name of a scene, photos or a video; a folder ``images`` has the name of its parent."""
    folder = data.resolve()
    return folder.stem if data.is_file() else folder.parent.name if folder.name == "images" else folder.name


def object_name(data: Path) -> str:
    """Return a name for the one object of photos: that of their folder or video, if it can name a class."""
    name = name_of(data).strip()
    return name if name.isprintable() and name not in ("", "background") and not name.startswith("-") else "object"


def made_scene(data: Path, output: Path, masks: bool = True, chosen: ChosenSource = SALIENT) -> MadeScene:
    """Return the scene in ``data``, or one made below ``output`` of photos without poses, or without masks.

    data: a scene, a folder of photos (or with images/, perhaps masks/), or a video. masks: whether they are needed.
    chosen: the source of masks where there are none. Results of an earlier call with the same photos are used again,
    masks also if the user mended them. Raises ``UserError``; if masks cannot be made, before poses are computed.
    """
    if data.is_dir() and (fitting_layouts(data) or any(any(data.glob(pattern)) for pattern in POSES)):
        read_dataset(data)  # It reports what is missing or superfluous.
        if not masks or _has_masks(data):
            _check_needed(chosen, data, masks)
            return MadeScene(data)
        check_source(chosen)
        return MadeScene(data, made_masks(data, output / "made", object_name(data), chosen))
    photos = [] if is_video(data) else find_photos(data)  # It reports bad photos before anything is downloaded.
    given = data if any((data / "masks").rglob("*.png")) else None
    scene = output / "scene"
    _check_other(data, scene)
    if given is not None:
        _check_needed(chosen, data, masks)
    if not masks:
        CONSOLE.print(f"{data} has no poses, so they are computed from the photos.")
        _print_poses(data, scene)
        _write_origin(data, scene)
        return MadeScene(scene)
    if given is None:
        check_source(chosen)
    elif find_spec("pycolmap") is not None:  # Without it the next step reports that.
        with_masks(check_photos(photos, scene / "images", progress_bar), given / "masks")
    CONSOLE.print(f"{data} has no poses, so they are computed from the photos.")
    own = None
    try:
        _print_poses(data, scene)
    except NothingFits as error:
        CONSOLE.print("The photos as a whole give no poses, so poses of the objects alone are tried.")
        if (own := _scene_of_objects(scene, output / "turned", given, object_name(data), chosen, room=False)) is None:
            raise error
    _write_origin(data, scene)
    if own is not None:
        return own
    if given is not None and (scene / MADE).exists():
        (scene / "classes.json").unlink(missing_ok=True)  # It belongs to masks made before the user gave some.
    labels = given or made_masks(scene, scene, object_name(data), chosen)
    if objects_seem_turned(scene / MODEL, (labels or scene) / "masks"):
        CONSOLE.print(
            "The poses explain few of the objects' features, as if the objects had turned while the room stood still: "
            "poses of the objects alone are tried."
        )
        own = _scene_of_objects(scene, output / "turned", given, object_name(data), chosen, room=True)
    return own or MadeScene(scene, labels)


def _print_poses(data: Path, scene: Path, masks: Path | None = None) -> None:
    for line in find_poses(data, scene, nullcontext(), masks):
        CONSOLE.print(line)
    trim_memory()  # Masks come next, in the same process.


def _scene_of_objects(
    scene: Path, folder: Path, given: Path | None, name: str, chosen: ChosenSource, room: bool
) -> MadeScene | None:
    """Make a scene in ``folder`` with poses from the objects' features alone.

    scene: its images/ are the photos. given: the folder that holds the user's masks/. name: of the object. room:
    whether ``scene`` has poses of the whole photos. Returns None, and prints why, if the objects have too few features
    for poses, or moved with the room.
    """
    labels, photos = given or folder / "labels", scene / "images"
    try:
        if given is None:
            _all_masks(photos, labels, name, chosen, scene / "masks" if room else None)
        _print_poses(photos, folder, labels / "masks")
    except (NothingFits, NothingFound) as error:
        CONSOLE.print(f"There are no poses of the objects alone: {error}")
        return None
    posed = json.loads((folder / REPORT).read_text(encoding="utf-8"))
    enough = posed["registered"] >= ENOUGH * posed["photos"]
    if not (poses_are_their_own(folder / MODEL, scene / MODEL, labels / "masks") if room else enough):
        result = f"the poses in {scene} stay" if room else "they are not used"
        CONSOLE.print(
            f"The poses of the objects alone are too few, or no better, so {result}. If the objects did turn, take "
            "more photos of them, or put masks of all that turned into masks/ beside the photos."
        )
        return None
    CONSOLE.print("Poses and training use the objects alone, because they turned while the room stood still.")
    return MadeScene(folder, labels, turned=True)


def _all_masks(photos: Path, labels: Path, name: str, chosen: ChosenSource, mended: Path | None) -> None:
    """Make masks of all photos, because held-out ones need poses too; masks in ``mended`` replace them.

    Only a newer file replaces a mask of an earlier call, because the user may have mended either.
    """

    def digest() -> str:
        return content_digest([path for path in [labels / MADE] if path.exists()])

    before = digest()
    made_masks(photos, labels, name, chosen)
    anew = digest() != before
    for mask in sorted(mended.glob("*.png")) if mended is not None else ():
        same = labels / "masks" / mask.name
        older = not anew and same.exists() and mask.stat().st_mtime_ns <= same.stat().st_mtime_ns
        if not older and not (same.exists() and same.read_bytes() == mask.read_bytes()):
            shutil.copyfile(mask, same)


def _write_origin(data: Path, scene: Path) -> None:
    if not (scene / MADE_OF).exists():
        write_text_atomically(json.dumps(str(data.resolve())), scene / MADE_OF)


def _check_other(data: Path, scene: Path) -> None:
    """Raise ``UserError`` if a scene was made of other photos."""
    try:
        former = json.loads((scene / MADE_OF).read_text())
    except (OSError, ValueError):
        return
    if former != str(data.resolve()):
        raise UserError(f"{scene} was made of {former}: give another --output for {data}.")


def _check_needed(chosen: ChosenSource, data: Path, masks: bool) -> None:
    """Raise ``UserError`` if a source of masks is chosen although the data have masks."""
    if masks and chosen != SALIENT:
        raise UserError(
            f"{data} has masks already: leave --mask-source out, or replace them by {chosen.command(data)} --overwrite."
        )


def _has_masks(data: Path) -> bool:
    from beags_plugin.views.data_options import DataOptions
    from beags_plugin.views.scene_data import SceneData

    parser = SceneData(DataOptions(data=data))
    masks, folder = parser.mask_files(*parser.posed_views())
    return any(masks) or any(folder.glob("**/*.png"))  # Training reports wrong names of masks.
