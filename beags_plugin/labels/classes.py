"""Masks (images of class ids) and class names on disk."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from beags_plugin.labels.class_ids import BACKGROUND, IGNORE, count_ids
from beags_plugin.labels.id_checks import check_ids, check_palettes
from beags_plugin.system.errors import UserError, writing
from beags_plugin.system.pasted import quoted
from beags_plugin.system.reading.images import read_image
from beags_plugin.system.reading.text import load_json, reason

if TYPE_CHECKING:
    from PIL.Image import Image

NO_TRUTH = "no_truth.json"
"""File in a folder of masks that says that a program drew them all, so that held-out ones are no ground truth."""
UNTOLD = 128
"""Grey value, in the mask of one object, of a pixel that may be inside or outside."""
SHADES = slice(32, 224)  # 8-bit values that are neither black nor white
MOST_SHADED, LEAST_SHADES = 0.25, 64  # share of shaded pixels, and number of shades, above which a mask is a picture
_ID_MODES = {"1", "L", "P", "I", "I;16", "I;16L", "I;16B"}  # Pillow's names of images with one integer per pixel
_COLOR_MODES = {"RGB", "RGBA", "LA"}


def read_id_mask(path: Path | str, ignore_ids: Iterable[int] = ()) -> np.ndarray:
    """Read class ids [H, W] uint16 from an 8-bit grey, 16-bit grey or palette image (its indices, not its colours).

    ignore_ids: ids of an 8-bit image that mean "unlabelled", such as 255; they become IGNORE (65535). Raises
    ``UserError`` for any other file.
    """
    mode, values = _read_pixels(path)
    if mode in _COLOR_MODES and _is_grey(mode, values):
        raise UserError(
            f"the mask {path} has colours (mode {mode}), though all are greys, where class ids are needed: save it "
            "with one channel, as 8-bit grey PNG."
        )
    if mode not in _ID_MODES or values.ndim != 2:
        folder = quoted(Path(path).parent)
        raise UserError(
            f"the mask {path} has colours (mode {mode}) where class ids are needed: save it as 8-bit or 16-bit grey "
            "PNG, or let each colour become an id with beags masks make --source id-images --options "
            f"folder={folder} colors=true."
        )
    if values.min(initial=0) < 0 or values.max(initial=0) > IGNORE:
        raise UserError(f"the mask {path} holds ids outside 0..{IGNORE}: save it as 8-bit or 16-bit grey PNG.")
    labels = values.astype(np.uint16)
    if mode in {"1", "L", "P"}:
        labels[np.isin(labels, list(ignore_ids))] = IGNORE
    return labels


def _is_grey(mode: str, values: np.ndarray) -> bool:
    """Return whether a colour image has equal channels, and a constant alpha if any."""
    alpha, colors = values[..., -1:], values[..., : 1 if mode == "LA" else 3]
    opaque = mode == "RGB" or bool((alpha == alpha.flat[0]).all())
    return opaque and bool((colors == colors[..., :1]).all())


def palette_of(path: Path | str) -> dict[int, tuple[int, int, int]] | None:
    """Return the colours of the ids in a palette image; None for other images, and if each colour is its index."""

    def read(image: Image) -> dict[int, tuple[int, int, int]] | None:
        if image.mode != "P" or image.palette is None:
            return None
        used = count_ids(np.asarray(image))[0].tolist()
        colors = np.zeros((256, 3), np.uint8)
        given = np.array(image.convert("P").getpalette("RGB") or [], np.uint8).reshape(-1, 3)
        colors[: len(given)] = given[:256]
        palette = {index: tuple(int(value) for value in colors[index]) for index in used}
        return None if all(color == (index,) * 3 for index, color in palette.items()) else palette  # type: ignore[return-value]

    return read_image(path, read, "the mask", "save it as PNG again")


def read_object_mask(path: Path | str, truth: bool = False) -> np.ndarray:
    """Read the mask of one object, [H, W] uint16: 1 inside, 0 outside, IGNORE where that is unknown.

    In 8-bit grey or colour images that reach 128, values of 128 or more are inside, as outlines may be blended. But in
    an image with the values 0, 128 and 255 alone, with 255 in it, grey 128 is ``UNTOLD``: a blended outline has more
    shades. In other images, such as labels 0 and 1, all values but 0 and IGNORE are inside. Alpha is ignored. truth:
    whether 128 is ``UNTOLD`` also without 255, as in a silhouette that is unknown everywhere. Raises ``UserError`` for
    any other file, such as a photo.
    """
    mode, values = _read_pixels(path)
    if mode in _COLOR_MODES:
        channels = values[..., : 1 if mode == "LA" else 3]
    elif mode in _ID_MODES and values.ndim == 2:
        channels = values[..., None]
    else:
        raise UserError(f"the mask {path} is of mode {mode}: save it as grey PNG.")
    brightest = channels.max(axis=2)
    if mode in {"L", *_COLOR_MODES} and brightest.max(initial=0) >= UNTOLD:
        if _is_picture(brightest):
            raise UserError(f"the mask {path} is a picture: fill the object white on black, without the photo below.")
        shades = set(count_ids(channels)[0].tolist())
        inside, untold = brightest >= UNTOLD, (channels == UNTOLD).all(axis=2)
        untold &= (255 in shades or truth) and shades <= {0, UNTOLD, 255}
    else:
        inside, untold = brightest != 0, brightest == IGNORE
    return np.where(untold, IGNORE, inside).astype(np.uint16)


def _is_picture(values: np.ndarray) -> bool:
    """Return whether many pixels have many shades; blended outlines are few pixels, and labels few values."""
    counts = np.bincount(values.ravel(), minlength=256)[SHADES]
    return bool(counts.sum() > MOST_SHADED * values.size and np.count_nonzero(counts) > LEAST_SHADES)


def _read_pixels(path: Path | str) -> tuple[str, np.ndarray]:
    """Read Pillow's mode and the values of a lossless image."""
    try:
        form, mode, values = read_image(
            path, lambda image: (image.format, image.mode, np.asarray(image)), "the mask", "save it as PNG again"
        )
    except FileNotFoundError:
        raise UserError(f"the mask {path} does not exist: check the path.") from None
    if form == "JPEG":
        raise UserError(f"the mask {path} is a JPEG, which blurs class ids: save it as 8-bit or 16-bit grey PNG.")
    return mode, values


def write_mask(path: Path | str, array: np.ndarray) -> None:
    """Write class ids as a grey PNG: 8 bits if they fit, else 16 (IGNORE needs 16).

    array: [H, W] integers in 0..65535. Raises ``UserError`` for another shape, dtype or range.
    """
    from PIL import Image

    array = np.asarray(array)
    if array.ndim != 2 or array.dtype.kind not in "iu" or array.size == 0:
        raise UserError(f"the class map for {path} must be [H, W] integers, not {list(array.shape)} {array.dtype}.")
    if array.min() < 0 or array.max() > IGNORE:
        raise UserError(
            f"the class map for {path} holds ids {array.min()}..{array.max()}: only 0..{IGNORE} can be saved."
        )
    with writing(path, "the class map "):
        Image.fromarray(array.astype(np.uint8 if array.max() <= 255 else np.uint16)).save(path, format="PNG")


def check_names(names: Mapping[int, str]) -> None:
    """Raise ``UserError`` for class names that ``read_classes`` would refuse."""
    for class_id, name in names.items():
        if not 0 <= class_id < IGNORE:
            raise UserError(f"the masks hold the class id {class_id}: only 0..{IGNORE - 1} can be used.")
        if not name.strip():
            raise UserError(f"the class {class_id} of the masks has no name: name it.")
    stripped = Counter(name.strip() for name in ({BACKGROUND: "background"} | dict(names)).values())
    if repeated := sorted(name for name, uses in stripped.items() if uses > 1):
        raise UserError(f"the masks give the name {repeated[0]!r} to two classes: rename one of the objects.")


def read_classes(path: Path | str | None, ids_present: Iterable[int] | None = None) -> dict[int, str]:
    """Read class names by ascending id from a JSON file {"id": "name"}; background (0) is added.

    path: None, or a missing file if ``ids_present`` is given, names no class. ids_present: ids in the masks; those
    without a name get "class_<id>". IGNORE is left out. Raises ``UserError`` for invalid JSON, an id outside 0..65534,
    an empty name, or a repeated name or id.
    """
    names = {BACKGROUND: "background"}
    if path is not None and (ids_present is None or Path(path).exists()):
        names.update(_read_names(Path(path)))
    for class_id in ids_present or ():
        if not 0 <= int(class_id) <= IGNORE:
            raise UserError(f"the masks hold the class id {class_id}: only 0..{IGNORE - 1} can be used.")
        if class_id != IGNORE:
            names.setdefault(int(class_id), f"class_{int(class_id)}")
    if repeated := sorted(name for name, uses in Counter(names.values()).items() if uses > 1):
        raise UserError(f"{path or 'classes.json'} gives the name {repeated[0]!r} to two classes: rename one of them.")
    return dict(sorted(names.items()))


def _read_names(path: Path) -> dict[int, str]:
    try:
        pairs = load_json(path, object_pairs_hook=list)
    except FileNotFoundError:
        raise UserError(f"the class names {path} do not exist: correct the path.") from None
    except (OSError, ValueError) as error:
        raise UserError(
            f'the class names {path} cannot be read as JSON ({reason(error)}): write e.g. {{"1": "cup"}}.'
        ) from None
    # The hook turns every object into a list of pairs, which keeps repeated ids.
    if not isinstance(pairs, list) or not all(isinstance(pair, tuple) for pair in pairs):
        raise UserError(f'the class names {path} must be one JSON object: write e.g. {{"1": "cup"}}.')
    names: dict[int, str] = {}
    for key, name in pairs:
        digits = key.isascii() and key.isdigit()
        if not digits or len(key) > 9 or int(key) >= IGNORE:  # Python refuses to convert thousands of digits
            short = key if len(key) <= 40 else f"{key[:37]}..."
            raise UserError(f"{path} has the class id {short!r}: ids are whole numbers in 0..{IGNORE - 1}.")
        if not isinstance(name, str) or not name.strip():
            raise UserError(f"{path} gives class {key} no name: write a non-empty string.")
        if not name.strip().isprintable():
            raise UserError(f"{path} gives class {key} the name {name!r:.60}: write one line of plain text.")
        if int(key) in names:
            raise UserError(f"{path} names class {int(key)} twice: keep one of the lines.")
        names[int(key)] = name.strip()
    return names


def read_class_names(
    classes_file: Path,
    masks: Sequence[Path],
    ignore_ids: Sequence[int],
    known: Mapping[int, str] | None = None,
    known_file: Path | None = None,
) -> dict[int, str]:
    """Return the class names by ascending id: from ``classes_file``, else ``known``, else ``class_<id>``.

    masks: id images, each read once. known, known_file: names from the layout, and their file. Raises ``UserError`` if
    names are given but a mask holds an id without one, and for masks that look damaged (``labels.id_checks``).
    """

    def ids_in(mask: Path) -> set[int]:
        labels = read_id_mask(mask, ignore_ids)
        check_ids(mask, labels)
        return set(np.flatnonzero(np.bincount(labels.ravel(), minlength=IGNORE + 1)).tolist()) - {IGNORE}

    with ThreadPoolExecutor(max_workers=4) as pool:  # decoding a .png releases the interpreter
        ids_of_masks = list(pool.map(ids_in, masks))
        check_palettes(masks, list(pool.map(palette_of, masks)))
    if classes_file.is_file():
        classes, source = read_classes(classes_file), classes_file
    elif known is not None:
        classes, source = dict(sorted({BACKGROUND: "background", **known}.items())), known_file or classes_file
    else:
        return read_classes(None, sorted(set().union(*ids_of_masks)))
    for mask, ids in zip(masks, ids_of_masks, strict=True):
        if unknown := sorted(ids - classes.keys()):
            raise UserError(
                f"the mask {mask} holds id {unknown[0]}, which {source} does not name: "
                f"add it there, correct the mask, or list it in ignore_ids."
            )
    return classes
