"""Images and masks of a data set on disk, and quick checks that they fit together."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from beags_plugin.data.orientation import upright_mask_error
from beags_plugin.system.errors import UserError
from beags_plugin.system.reading.images import read_image

if TYPE_CHECKING:
    from PIL.Image import Image

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp")
_ENDS = {"PNG": b"IEND", "JPEG": b"\xff\xd9"}
LARGEST_WIDTH = 1600  # pixels


def list_images(folder: Path) -> list[Path]:
    """Return the images directly in a folder, sorted by name; empty if the folder does not exist."""
    if not folder.is_dir():
        return []
    files = (path for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES and path.is_file())
    files = (path for path in files if not path.name.startswith("."))  # macOS writes such files on other disks
    return sorted(files, key=lambda path: path.name)


OWN_PICTURES = ("made.png", "contradicted.png", "poses.png", "contact_sheet.png")
"""Pictures that commands of this package write into a scene's folder, and that are no photos."""


def list_photos(data: Path) -> list[Path]:
    """Return the photos of a folder, in ``folder_of_photos``, sorted by name."""
    return [path for path in list_images(folder_of_photos(data)) if path.name not in OWN_PICTURES]


def folder_of_photos(data: Path) -> Path:
    """Return the folder ``images`` in ``data`` if it holds images or ``data`` itself holds none; else ``data``."""
    images = data / "images"
    return images if images.is_dir() and (list_images(images) or not list_images(data)) else data


def image_folders(root: Path) -> list[Path]:
    """Return the folders ``images``, ``images_2``, ... that hold images, the largest images first."""
    numbered = {}
    for folder in root.glob("images*"):
        if (match := re.fullmatch(r"images(?:_(\d+))?", folder.name)) and list_images(folder):
            numbered[folder] = int(match[1] or 1)
    return sorted(numbered, key=lambda folder: numbered[folder])


def choose_images(root: Path, chosen: Path | None = None) -> Path:
    """Return ``chosen``, else the folder of the largest copies with at most ``LARGEST_WIDTH`` pixels on a side.

    Raises ``UserError`` if there is no image.
    """
    folders = [chosen] if chosen is not None else image_folders(root)
    folders = [folder for folder in folders if list_images(folder)]
    if not folders:
        where = chosen or f"{root / 'images'} (or images_2, images_4, images_8)"
        raise UserError(f"{where} holds no images: restore them, or give --images-path.")
    fitting = (folder for folder in folders if max(image_size(list_images(folder)[0])) <= LARGEST_WIDTH)
    return next(fitting, folders[-1])


def largest_images(root: Path, chosen: Path | None = None) -> tuple[Path, float]:
    """Return ``chosen`` and 1, else the folder of the largest copies and the factor to ``LARGEST_WIDTH``.

    Raises ``UserError`` if there is no image.
    """
    folders = [] if chosen is not None else image_folders(root)
    if not folders:
        return choose_images(root, chosen), 1.0
    return folders[0], max(image_width(folders[0]) / LARGEST_WIDTH, 1.0)


def size_note(folder: Path, downscale: float = 1.0) -> str:
    """Return a sentence on the size of the images that a layout has chosen."""
    others = "other sizes: beags-data --images-path FOLDER or --downscale-factor N"
    return f"The images of {folder.name} are used {round(image_width(folder) / downscale)} pixels wide ({others})."


def numbered(files: Sequence[Path], count: int) -> tuple[list[int] | None, tuple[Path, ...]]:
    """Return which of ``count`` photos ``files`` are if some are missing, and the paths of the missing ones.

    The numbers at the ends of their names tell: these count from 0, or the first and the last photo are there. None and
    () if none are missing, or the numbers do not tell which.
    """
    numbers = [end[0] for file in files if (end := re.search(r"\d+$", file.stem)) is not None]
    places = [int(number) for number in numbers]
    if not 0 < len(set(places)) == len(files) < count:
        return None, ()
    shift = 0
    if max(places) >= count and max(places) - (shift := min(places)) != count - 1:
        return None, ()
    places = [place - shift for place in places]
    first, digits = files[0], len(numbers[0])
    start, absent = first.stem[:-digits], sorted(set(range(count)) - set(places))
    return places, tuple(first.with_name(f"{start}{index + shift:0{digits}d}{first.suffix}") for index in absent)


def image_width(folder: Path) -> int:
    """Return the width in pixels of the first of the images in a folder."""
    return image_size(list_images(folder)[0])[0]


def image_size(path: Path, what: str = "the image") -> tuple[int, int]:
    """Read width and height in pixels from the file's header; raise ``UserError`` for an image that is cut off."""

    def read(image: Image) -> tuple[int, int]:
        if (end := _ENDS.get(image.format or "")) is not None and end not in _last_bytes(path):
            image.load()  # raises, unless only other data follow the image's end, as in phones' moving photos
        return image.size

    try:
        return read_image(path, read, what)
    except FileNotFoundError:
        raise UserError(f"{what} {path} does not exist: restore it, or remove it from the poses.") from None


def _last_bytes(path: Path) -> bytes:
    with path.open("rb") as file:
        file.seek(max(0, file.seek(0, os.SEEK_END) - 16))
        return file.read()


def photo_names(images: Sequence[Path]) -> list[str]:
    """Return each image's path below their common folder, without suffix, such as "v1" or "left/v1".

    Raises ``UserError`` if two images share a name, as masks are found by it.
    """
    if not images:
        return []
    root = Path(os.path.commonpath([image.parent for image in images]))
    named: dict[str, Path] = {}
    for image in images:
        name = image.relative_to(root).with_suffix("").as_posix()
        if (other := named.get(name)) is not None:
            raise UserError(
                f"the poses name {image} twice: keep one of them."
                if other == image
                else f"the images {other} and {image} are both called {name}, by which their masks are found: rename "
                "one of them, in the poses too."
            )
        named[name] = image
    return list(named)


def files_of_views(folder: Path, images: Sequence[Path], images_root: Path) -> list[Path | None]:
    """Find each image's .png in ``folder`` by its path below ``images_root``, else by its stem; None without one.

    Names with the image's suffix, as COLMAP writes them (v1.jpg.png), are found too. Raises ``UserError`` if several
    images share the stem of a file.
    """
    if not folder.is_dir():
        return [None] * len(images)
    present = {
        path.relative_to(folder).with_suffix("").as_posix(): path
        for path in sorted(folder.rglob("*"))
        if path.suffix.lower() == ".png" and not path.name.startswith(".")
    }
    stems = Counter(image.stem for image in images)
    files: list[Path | None] = []
    for image in images:
        below = image.relative_to(images_root) if image.is_relative_to(images_root) else Path(image.name)
        own = (present.get(name) for name in (below.with_suffix("").as_posix(), below.as_posix()))
        file = next((path for path in own if path is not None), None)
        if file is None and (file := present.get(image.stem) or present.get(image.name)) and stems[image.stem] > 1:
            raise UserError(
                f"{file} could belong to {stems[image.stem]} images called {image.stem}: "
                f"put it at the image's own path below {folder}."
            )
        files.append(file)
    return files


def unposed_note(posed: Sequence[Path]) -> str | None:
    """Return a sentence on photos in the folders of the posed ones that have no pose; None if all have one."""
    known = {path.with_suffix("") for path in posed}
    folders = sorted({path.parent for path in posed})
    photos = [path for folder in folders for path in list_images(folder) if path.name not in OWN_PICTURES]
    without = [path for path in photos if path.with_suffix("") not in known]
    if not without:
        return None
    if len(without) == 1:
        return f"The photo {without[0]} has no pose, so it is not used."
    return f"{len(without)} photos have no pose, so they are not used; the first of them is {without[0]}."


def check_mask_files(folder: Path, images: Sequence[Path]) -> None:
    """Raise ``UserError`` for a folder that holds masks, none of which belongs to an image."""
    files = sorted(path for path in folder.rglob("*") if not path.name.startswith(".") and path.is_file())
    pictures = [path for path in files if path.suffix.lower() in IMAGE_SUFFIXES]
    stems = {image.stem for image in images}
    if other := next((path for path in files if path.suffix.lower() != ".png" and path.stem in stems), None):
        why, make = "masks are .png files", "save"
        if other.suffix.lower() in (".jpg", ".jpeg"):
            why, make = "JPEG blurs class ids", "make them anew and save"
        raise UserError(
            f"the masks in {folder} are {other.suffix} files, as {other.name}, but {why}: {make} them as PNG."
        )
    if any(path.suffix.lower() == ".png" for path in pictures):
        raise UserError(
            f"no mask in {folder} has the name of an image ({images[0].stem}.png, ...): rename the masks, or give "
            "another masks_path."
        )


def same_proportions(size: tuple[int, int], other: tuple[int, int]) -> bool:
    """Return whether two sizes (width, height) may be of copies of one image, whose sides are rounded to pixels."""
    (width, height), (other_width, other_height) = size, other
    expected = other_width * height / width
    return abs(expected - other_height) <= 1.0 + expected / other_width


def check_same_size(
    masks: Sequence[Path | None], sizes: Sequence[tuple[int, int]], images: Sequence[Path] | None = None
) -> None:
    """Raise ``UserError`` for the first mask that differs in size from its image (width, height).

    images: the images' files, which may be stored on their side, or None.
    """
    for index, (mask, (width, height)) in enumerate(zip(masks, sizes, strict=True)):
        if mask is not None and (found := image_size(mask, "the mask")) != (width, height):
            if images and (sentence := upright_mask_error(mask, found, images[index], (width, height))):
                raise UserError(sentence)
            raise UserError(
                f"the mask {mask} is {found[0]}x{found[1]} pixels but its image is {width}x{height}: "
                f"make the mask from that image, or name images of its size with beags-data --images-path."
            )
