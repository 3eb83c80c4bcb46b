"""The captures: their objects, the masks that they can be trained on, and those on disk."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from beags_benchmarks.experiments.captures.options import CapturesOptions
from beags_benchmarks.experiments.experiment import FILES
from beags_benchmarks.experiments.scenes import SceneSize, TrialScene, quiet
from beags_plugin.data.files import image_size, list_images, same_proportions
from beags_plugin.system.digests import folder_digest
from beags_plugin.system.errors import UserError, check_choice

GIVEN, PICKED, SALIENT = "given", "picked", "salient"
KINDS = (GIVEN, PICKED, SALIENT)
"""Kinds of masks: from the capture's folder; cut from the base by committed clicks; salient objects by a network."""
QUICK_SIZE = 130  # pixels of a photo's longer side
LEAST_SIZE = 16


@dataclass(frozen=True)
class Capture:
    """One capture.

    name: name of its folder. masks: kinds of masks that it is trained on. objects: objects with traced silhouettes.
    own_truth: whether its given masks are the truth, because they are exact and its objects are never occluded.
    """

    name: str
    masks: tuple[str, ...]
    objects: tuple[str, ...] = ()
    own_truth: bool = False

    @property
    def prompts(self) -> Path:
        """Return the file with the clicks that pick its objects."""
        return FILES / "captures" / "prompts" / f"{self.name}.json"


CAPTURES = (
    Capture("bear", (PICKED, SALIENT), ("object",)),
    Capture("kitchen", (PICKED, SALIENT), ("object",)),
    Capture("garden", (PICKED,), ("vase", "table")),
    Capture("fruit", (GIVEN,), ("apple", "banana")),
    Capture("dtu_skull", (GIVEN, SALIENT), own_truth=True),
    Capture("figurine", (SALIENT,)),  # figurine and fern have no truth and are for pictures
    Capture("fern", (PICKED,)),
)
"""The network marks one object, so only captures of one object have salient masks."""


@dataclass(frozen=True)
class FoundCapture:
    """A capture on disk. photos: scene for bases. size: size of ``photos``. truth: folder of silhouettes, or None."""

    capture: Capture
    photos: TrialScene
    size: SceneSize
    truth: Path | None


def find_captures(options: CapturesOptions) -> tuple[list[FoundCapture], list[str]]:
    """Return the requested captures on disk, and a sentence for each that is missing or lacks its truth.

    Raises ``UserError`` for an option that cannot be used, and if no capture is left.
    """
    _check(options)
    wanted = [capture for capture in CAPTURES if not options.scenes or capture.name in options.scenes]
    captures, lines = [], []
    for capture in wanted:
        folder = options.data_root / capture.name
        if not folder.is_dir():
            lines.append(f"{capture.name} is left out: {folder} is no folder.")
            continue
        try:
            each, notes = _found(capture, folder, options)
        except UserError as error:
            lines.append(f"{capture.name} is left out: {error}")
            continue
        captures.append(each)
        lines += notes
        if options.quick and not options.scenes:
            break
    if not captures:
        names = ", ".join(capture.name for capture in wanted)
        why = f" ({lines[0]})" if len(wanted) == 1 else ""
        raise UserError(f"{options.data_root} holds none of {names} that can be read{why}: name the folder above them.")
    return captures, lines


def _check(options: CapturesOptions) -> None:
    if not options.data_root.is_dir():
        raise UserError(f"the data root {options.data_root} is no folder: name the one that holds the captures.")
    if options.truth is not None and not options.truth.is_dir():
        raise UserError(f"the truth {options.truth} is no folder: name the one that holds <capture>/<object>/*.png.")
    if options.size < LEAST_SIZE:
        raise UserError(f"size is {options.size}: give {LEAST_SIZE} pixels or more.")
    for name in options.scenes:
        check_choice(name, [capture.name for capture in CAPTURES], "capture")
    for kind in options.masks:
        check_choice(kind, KINDS, "kind of masks")


def _found(capture: Capture, folder: Path, options: CapturesOptions) -> tuple[FoundCapture, list[str]]:
    parser = TrialScene(capture.name, folder.resolve(), 1.0, "").parser()
    with quiet():
        opened = parser.setup()
        _, views = opened.posed_views()
        longest = max(max(image_size(image)) for image in views.images)
        parser.downscale_factor = max(1.0, longest / (min(options.size, QUICK_SIZE) if options.quick else options.size))
        loader = parser.setup()
        training, held_out = (loader.get_dataparser_outputs(split) for split in ("train", "test"))
    size = SceneSize.of(training)
    photos = TrialScene(capture.name, folder.resolve(), parser.downscale_factor, folder_digest(folder))
    if not capture.objects or options.truth is None:
        return FoundCapture(capture, photos, size, None), []
    truth = options.truth / capture.name
    notes = _truth_notes(capture, truth, {image.stem: image for image in held_out.image_filenames})
    return FoundCapture(capture, photos, size, truth.resolve() if truth.is_dir() else None), notes


def _truth_notes(capture: Capture, truth: Path, held_out: Mapping[str, Path]) -> list[str]:
    """Return sentences about silhouettes that are missing or have no held-out photo. held_out: photos by their stems.

    Raises ``UserError`` for a silhouette with other proportions than its photo.
    """
    notes = []
    for name in capture.objects:
        files = list_images(truth / name)
        others = [file for file in files if file.stem not in held_out]
        if not files:
            notes.append(f"{capture.name}: no silhouette of {name} lies in {truth / name}, so it is not scored.")
        elif len(others) == len(files):
            notes.append(
                f"{capture.name}: no file in {truth / name} is named as a held-out photo, so {name} is not scored: "
                "these silhouettes may be of another scene."
            )
        elif others:
            more = f" and {len(others) - 1} more are" if len(others) > 1 else " is"
            notes.append(f"{capture.name}: {others[0]}{more} of no held-out photo and not scored.")
        for file in files:
            photo = held_out.get(file.stem)
            if photo is not None and not same_proportions(image_size(photo), size := image_size(file)):
                raise UserError(
                    f"the silhouette {file} is {size[0]} x {size[1]} pixels, which are other proportions than those of "
                    f"{photo}: trace it in that photo, or take it away."
                )
    return notes


def kinds_of(captures: Sequence[FoundCapture], options: CapturesOptions) -> list[tuple[FoundCapture, str]]:
    """Return every capture with each requested kind of masks that it has; raises ``UserError`` if there is none."""
    pairs = [
        (each, kind) for each in captures for kind in each.capture.masks if not options.masks or kind in options.masks
    ]
    if not pairs:
        names = ", ".join(each.capture.name for each in captures)
        raise UserError(f"none of {names} is trained on masks of the kind {', '.join(options.masks)}: name another.")
    return pairs
