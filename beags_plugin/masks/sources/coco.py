"""Source of masks: COCO's JSON, with run lengths or polygons."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from beags_plugin.data.orientation import upright_mask_error
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.masks.sources.base import MadeMasks, MaskSource, Photo, Progress, SourceScene, per_photo, stacked
from beags_plugin.system.errors import UserError
from beags_plugin.system.reading.text import load_json, reason

FARTHEST = 1e5  # largest coordinate of a polygon's points, pixels; the library rasterizes all of them
INSTANCE_KEYS = ("instance_id", "track_id", "object_id")


@dataclass(frozen=True)
class CocoSource(MaskSource):
    """COCO annotations: ``images``, ``categories``, and ``annotations`` with a ``segmentation``, RLE or polygons.

    file: the JSON. by: what makes annotations one object: "category", or "instance" for the same instance_id, track_id
    or object_id. Smaller objects cover larger ones.
    """

    file: Path = Path("annotations.json")
    by: Literal["category", "instance"] = "category"

    def make(self, scene: SourceScene, progress: Progress) -> MadeMasks:
        path = scene.below(self.file)
        try:
            content = load_json(path)
            views = {image["id"]: str(image["file_name"]) for image in content["images"]}
            sizes = {str(image["file_name"]): (image.get("width"), image.get("height")) for image in content["images"]}
            categories = {entry["id"]: str(entry["name"]) for entry in content.get("categories", [])}
            annotations = [(views[entry["image_id"]], self._key(entry), entry) for entry in content["annotations"]]
        except OSError as error:
            raise UserError(f"{path} cannot be read ({error.strerror}): give options file=...") from error
        except (AttributeError, ValueError, KeyError, TypeError) as error:
            raise UserError(
                f"{path} is no COCO JSON with images and annotations ({reason(error)}): export it again."
            ) from error
        names_of = scene.names.assigned(
            {name: name for name in views.values()}, lambda name: f"the image {name} of {path}"
        )
        if not set(names_of.values()) & {view for view, _, _ in annotations}:
            raise UserError(f"{path} annotates no image of {scene.root}: its file_name must be theirs.")
        # Numbers come before words.
        keys = sorted({key for _, key, _ in annotations}, key=lambda key: [(isinstance(k, str), k) for k in key])
        if len(keys) > IGNORE - 1:
            raise UserError(f"{path} has {len(keys)} objects: only {IGNORE - 1} ids can be saved.")
        ids = {key: index for index, key in enumerate(keys, 1)}
        of_view: dict[str, list[tuple[int, Any]]] = defaultdict(list)
        for view, key, entry in annotations:
            of_view[view].append((ids[key], entry.get("segmentation")))
        annotated = {scene.photos[index].name: view for index, view in names_of.items()}

        def read(photo: Photo) -> np.ndarray | None:
            if photo.name not in annotated:
                return None
            shape = (photo.height, photo.width)
            _check_size(path, photo, sizes[annotated[photo.name]])
            whole: dict[int, np.ndarray] = {}  # an object may have several annotations
            for class_id, segmentation in of_view[annotated[photo.name]]:
                mask = decoded(segmentation, shape, f"{path}, image {photo.name}")
                whole[class_id] = whole.get(class_id, False) | mask
            return stacked(list(whole.items()), shape)

        names = {0: "background"}
        for (category, instance), index in ids.items():
            title = categories.get(category, f"category_{category}")
            names[index] = title if self.by == "category" else f"{title}_{instance}"
        return MadeMasks(names, per_photo(scene, progress, read), [])

    def _key(self, entry: dict[str, Any]) -> tuple[int | str, int | str]:
        """Return the key of an annotation's object: (category, instance)."""
        if self.by == "category":
            return _number_or_word(entry["category_id"]), 0
        for key in INSTANCE_KEYS:
            if key in entry:
                return _number_or_word(entry.get("category_id", 0)), _number_or_word(entry[key])
        raise UserError(f"an annotation has none of {', '.join(INSTANCE_KEYS)}: use options by=category.")


def _number_or_word(value: Any) -> int | str:
    """Return an id from JSON; raise ``ValueError`` for anything but a number or a word."""
    if not isinstance(value, (int, str)):
        raise ValueError(f"the id {value!r} is neither a whole number nor a word")
    return value


def _check_size(path: Path, photo: Photo, size: tuple[Any, Any]) -> None:
    """Raise ``UserError`` if the JSON gives an image another (width, height) than its photo has."""
    if not all(type(side) is int for side in size) or size == (photo.width, photo.height):
        return
    whose = f"of {photo.name} in {path}"
    if sentence := upright_mask_error(whose, size, photo.path, (photo.width, photo.height)):
        raise UserError(sentence)
    raise UserError(
        f"{path}, image {photo.name}: it is annotated at {size[0]}x{size[1]} pixels but is "
        f"{photo.width}x{photo.height}: annotate the image at its full size."
    )


def packed_total(counts: str) -> int:
    """Sum the run lengths in COCO's packed text: 5 bits a character, each length stored minus the one two before.

    Raises ``ValueError`` for other text and for negative lengths, neither of which the library checks.
    """
    lengths: list[int] = []
    value = shift = 0
    for character in counts:
        code = ord(character) - 48
        if not 0 <= code < 64 or shift > 30:
            raise ValueError("the counts are no packed run lengths")
        value |= (code & 31) << shift
        shift += 5
        if code & 32:
            continue
        if code & 16:
            value -= 1 << shift
        length = value + (lengths[-2] if len(lengths) > 2 else 0)
        if length < 0:
            raise ValueError("a run has a negative length")
        lengths.append(length)
        value = shift = 0
    if shift:
        raise ValueError("the counts are cut off")
    return sum(lengths)


def _check_polygons(polygons: Any) -> None:
    """Raise ``ValueError`` unless each polygon is a list x, y, ... of at least three points near the image."""
    if not isinstance(polygons, list) or not polygons:
        raise ValueError("it is no list of polygons")
    for polygon in polygons:
        if not isinstance(polygon, list) or len(polygon) < 6 or len(polygon) % 2:
            raise ValueError("a polygon is no list of three points or more")
        if not all(type(value) in (int, float) and abs(value) < FARTHEST for value in polygon):
            raise ValueError("a polygon has a point far outside the image")


def decoded(segmentation: Any, shape: tuple[int, int], where: str) -> np.ndarray:
    """Decode {"size", "counts"} or a list of polygons to [H, W] bool. where: names the annotation in errors."""
    from pycocotools import mask

    coco: Any = mask  # its types are incomplete
    height, width = shape
    try:
        if isinstance(segmentation, dict):
            if list(segmentation["size"]) != [height, width]:
                raise UserError(
                    f"{where}: a mask is {segmentation['size'][1]}x{segmentation['size'][0]} pixels but its image is "
                    f"{width}x{height}: annotate the image at its full size."
                )
            counts = segmentation["counts"]
            if isinstance(counts, list):
                if not all(type(count) is int and 0 <= count <= height * width for count in counts):
                    raise ValueError("the counts are no lengths of runs")
                if sum(counts) != height * width:
                    raise ValueError(f"the counts sum to {sum(counts)}")
                runs = coco.frPyObjects(segmentation, height, width)
            else:
                if not isinstance(counts, str):
                    raise ValueError("the counts are neither a list nor text")
                if (total := packed_total(counts)) != height * width:
                    raise ValueError(f"the counts sum to {total}")
                runs = {"size": [height, width], "counts": counts.encode("ascii")}
        else:
            _check_polygons(segmentation)
            runs = coco.merge(coco.frPyObjects(segmentation, height, width))
        return coco.decode(runs).astype(bool)
    except UserError:
        raise
    except Exception as error:  # the library raises errors of any type
        raise UserError(f"{where}: a segmentation is neither RLE nor polygons ({error}): export it again.") from error
