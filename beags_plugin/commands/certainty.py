"""Judge how reliable the result of ``beags demo`` is, in words for its last lines and for summary.json."""

from __future__ import annotations

import shutil
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from beags_plugin.commands.answers import read_object
from beags_plugin.commands.demo_again import Again
from beags_plugin.commands.photo_coverage import Coverage
from beags_plugin.commands.scene_setup import MadeScene
from beags_plugin.labels.class_ids import BACKGROUND, IGNORE
from beags_plugin.masks.separate_things import Things
from beags_plugin.system.pasted import quoted
from beags_plugin.system.wording import amount, verb

SURE, FAIR = 0.9, 0.75  # Least agreement between the views for "sure" and "fairly sure".
MANY = 0.1  # With a larger share of masks overruled as a whole, the demo is not sure.
FAR, SOME = 0.2, 0.05  # With a larger share of masks that contradict the others by more than FAR, it is not "sure".
OF_AGREEMENT = ("agreement", "masks", "overruled", "misplaced", "doubtful")
FEWEST = 3  # Masks with an object that can be compared.
NAMED = 6  # Photos named in a sentence.
MOST = 12  # Files named in a command.
SMALL = 150  # An object whose longer side has fewer pixels shows no printed text.
PICTURES = 6  # Views in doubt.png.


@dataclass(frozen=True)
class Certainty:
    """A judgement of a demo's result.

    level: "sure", "fairly sure", "not sure", or "not judged" if no network made the masks. lines: sentences for the
    user, with what to do next. figures: the values behind them, for JSON.
    """

    level: str
    lines: list[str]
    figures: dict[str, Any] = field(default_factory=dict)


def certainty(
    run: Path, scene: MadeScene, again: Again, apart: Path | None = None, seen: Coverage | None = None
) -> Certainty:
    """Judge a finished demo.

    run: its run. scene: of its photos, with poses.json if poses were computed. again: the demo's command.
    apart: the folder of the masks of separated things, with the report on their agreement. seen: what the photos show.
    """
    lines, figures = [], {}
    prepared = read_object(run / "prepared/report.json")
    agreement = read_object(apart / "report.json") if apart else prepared.get("agreement")
    level = "not judged" if agreement is None else _level(agreement)
    if agreement is not None:
        figures["agreement"] = {name: agreement[name] for name in OF_AGREEMENT if name in agreement}
        lines.append(_of_masks(level, agreement, left_out=apart is None))
    elif scene.mended:
        lines.append(
            "How sure: not judged, as the masks are no longer those that the network made: all count as they are."
        )
    things = None if agreement is None or "things" not in agreement else Things(**agreement["things"])
    if things is not None:
        figures["things"] = asdict(things)
        lines += [things.sentence()] if things.sentence() else []
    posed = read_object(scene.data / "poses.json")
    if {"photos", "registered"} <= set(posed):
        without = int(posed["photos"]) - int(posed["registered"])
        figures["photos without poses"] = without
        if without:
            lines.append(_without_poses(without, int(posed["photos"]), posed.get("without_pose", [])))
    if scene.without:
        figures["left out"] = list(scene.without)
        names = ", ".join(scene.without[:MOST]) + (" ..." if len(scene.without) > MOST else "")
        lines.append(f"{len(scene.without)} photos seemed to have a wrong pose and were left out ({names}).")
    if seen is not None:
        figures |= seen.figures()
        lines += seen.lines()
    if boxes := _boxes(run / "prepared/masks"):
        magnified = prepared.get("magnified", 1.0)
        width, height = (round(magnified * side) for side in np.median([box for _, box in boxes], axis=0))
        figures["object pixels"] = [width, height]
        subject = "The object has" if len({class_id for class_id, _ in boxes}) == 1 else "Objects have"
        where = "close-ups" if magnified > 1 else "photos"
        larger = again.larger() if max(width, height) < SMALL and magnified == 1 else None
        end = ". If your photos are larger, train on them at their full size:" if larger else "."
        lines.append(f"{subject} about {width} x {height} pixels in the {where} that training saw{end}")
        lines += [f"    {larger} --fresh"] if larger else []
    if agreement is not None:
        lines += _next(again, agreement, scene)
    return Certainty(level, lines, figures)


def _level(agreement: dict[str, Any]) -> str:
    masks = agreement["masks"]
    if masks < FEWEST:
        return "not judged"
    overruled, far = len(agreement["overruled"]) / masks, len(_far(agreement)) / masks
    if agreement["agreement"] < FAIR or overruled > MANY:
        return "not sure"
    return "sure" if agreement["agreement"] >= SURE and not overruled and far <= SOME else "fairly sure"


def _far(agreement: dict[str, Any]) -> set[str]:
    """Return the views whose masks contradict the others by more than ``FAR``."""
    return {each["view"] for each in agreement["views"] if (each["contradicts"] or 0.0) > FAR}


def _of_masks(level: str, agreement: dict[str, Any], left_out: bool) -> str:
    """Return how sure the result is. left_out: whether training left out pixels in doubt, not only votes on them."""
    masks, overruled = agreement["masks"], agreement["overruled"]
    if masks < FEWEST:
        return f"How sure: {level}, as only {amount(masks, 'mask', 'show')} an object."
    line = f"How sure: {level}. The views agree on {100 * agreement['agreement']:.0f} % of what they call the object"
    if overruled:
        line += f"; {len(overruled)} of {masks} masks {'was' if len(overruled) == 1 else 'were'} overruled as a whole"
    others = len(_far(agreement) - {*overruled, *agreement.get("misplaced", [])})
    if others > SOME * masks:
        more = " more" if overruled else ""
        line += f"; {others}{more} {verb(others, 'contradict')} the others on over {100 * FAR:.0f} %"
    doubt = f"{100 * agreement['doubtful']:.1f} % of all pixels are in doubt"
    return f"{line}; {doubt}{' and were left out' if left_out else ''}."


def _without_poses(without: int, photos: int, names: list[str]) -> str:
    named = ", ".join(names[:NAMED]) + (" ..." if len(names) > NAMED else "")
    were = "was" if without == 1 else "were"
    in_brackets = f" ({named})" if named else ""
    return f"{without} of {photos} photos {verb(without, 'have')} no pose and {were} left out{in_brackets}."


def _next(again: Again, agreement: dict[str, Any], scene: MadeScene) -> list[str]:
    """Return what the user can do, with commands to paste."""
    lines = [
        "Masks that agree may still mark something else than you meant. To pick it by a few clicks:",
        f"    {again.picking()} --fresh",
    ]
    if (masks := scene.made_masks) is not None and agreement["overruled"]:
        names = [quoted(masks / f"{name}.png") for name in agreement["overruled"][:MOST]]
        more = len(agreement["overruled"]) - len(names)
        others = f" ({more} more)" if more else ""
        lines += [f"Or delete the masks that contradict the others{others}, and train again:",
                  f"    rm {' '.join(names)}", f"    {again} --fresh"]  # fmt: skip
    if misplaced := agreement.get("misplaced"):
        names = ", ".join(misplaced[:MOST]) + (" ..." if len(misplaced) > MOST else "")
        fit = "its mask fits" if len(misplaced) == 1 else "their masks fit"
        lines.append(
            f"{amount(len(misplaced), 'photo', 'seem')} to have a wrong pose ({names}): {fit} the object only when "
            "shifted. Without such photos the object may be sharper: run the demo on the others, with another --output."
        )
    return lines


def _boxes(masks: Path) -> list[tuple[int, tuple[int, int]]]:
    """Return the class, and width and height of the bounding box in pixels, of every object in every photo's mask."""
    from beags_plugin.labels.classes import read_id_mask
    from beags_plugin.views.close_ups import CLOSE_UPS

    boxes = []
    for path in sorted(path for path in masks.rglob("*.png") if path.relative_to(masks).parts[0] != CLOSE_UPS):
        labels = read_id_mask(path)
        for class_id in np.setdiff1d(labels, [BACKGROUND, IGNORE]).tolist():
            rows, columns = np.nonzero(labels == class_id)
            boxes.append((class_id, (int(np.ptp(columns)) + 1, int(np.ptp(rows)) + 1)))
    return boxes


def write_doubt(run: Path, path: Path, apart: Path | None = None) -> bool:
    """Write a picture of the views whose masks changed most; if none changed, remove an old one and return False.

    apart: the folder of the masks of separated things, with such a picture.
    """
    if apart is not None and (apart / path.name).exists():
        shutil.copyfile(apart / path.name, path)
        return True
    from beags_plugin.pictures.masks import Changed, before_and_after
    from beags_plugin.runs.prepared import training_masks
    from beags_plugin.runs.relocation import open_run
    from beags_plugin.system.reading.images import read_image

    agreement = read_object(run / "prepared/report.json").get("agreement") or {"views": []}
    shares = {each["view"]: each["changed"] + each["doubtful"] for each in agreement["views"]}
    worst = sorted((name for name in shares if shares[name] > 0), key=lambda name: -shares[name])[:PICTURES]
    if not worst:
        path.unlink(missing_ok=True)
        return False
    views = {each.name: each for each in training_masks(open_run(run / "config.yml"))}
    rows = []
    for name in worst:
        view = views[name]
        height, width = view.used.shape
        photo = read_image(view.photo, lambda image, size=(width, height): np.array(image.convert("RGB").resize(size)))
        changed = np.zeros(view.used.shape, bool) if view.given is None else view.given != view.used
        grey = np.where(view.used == IGNORE, 0, np.where(changed, 128, 255)).astype(np.uint8)
        rows.append(Changed(name, photo, view.given, view.used, grey))
    before_and_after(path, rows, "black: in doubt, grey: changed")
    return True
