"""Reader of images: a few formats only, and no more pixels than a large photograph has."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, TypeVar

from beags_plugin.system.errors import UserError
from beags_plugin.system.reading.stand_ins import stand_in
from beags_plugin.system.reading.text import reason

if TYPE_CHECKING:
    from PIL.Image import Image

FORMATS = ("PNG", "JPEG", "TIFF", "BMP", "WEBP")
"""Pillow's formats that photos and masks have; for some of the others Pillow starts programs."""
MOST_PIXELS = 178_956_970
"""Pillow's own limit: half a gigabyte of colours."""

_FILTERS = Lock()  # Python's filters of warnings belong to all threads.

T = TypeVar("T")


def read_image(
    path: Path | str,
    read: Callable[[Image], T],
    what: str = "the image",
    remedy: str = "replace it",
    enough: int | None = None,
) -> T:
    """Open an image and return ``read(image)``.

    what: the user's word for the image. remedy: what to do. enough: pixels of the longer side that suffice; a JPEG of
    at least twice as many is decoded at 1/2, 1/4 or 1/8 of its size if that divides both sides, which is many times
    faster. Raises ``FileNotFoundError``, and ``UserError`` if the file is no such image, is cut off or has too many
    pixels.
    """
    from PIL import Image, UnidentifiedImageError

    def broken(why: str) -> UserError:
        return UserError(f"{what} {path} cannot be read as an image ({why}): {remedy}.")

    try:
        with _FILTERS, warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # Pillow warns from half as many pixels on
            image = Image.open(path, formats=FORMATS)
        with image:
            width, height = image.size
            if width * height > MOST_PIXELS:
                raise Image.DecompressionBombError
            if enough is not None and (part := _part(width, height, enough)) > 1:
                image.draft(None, (width // part, height // part))
            return read(image)
    except (UserError, FileNotFoundError):
        raise
    except UnidentifiedImageError as error:
        if (cause := stand_in(path)) is not None:
            raise UserError(f"{what} {path} cannot be read: {cause}.") from error
        raise broken(f"it is none of {', '.join(FORMATS)}") from error
    except Image.DecompressionBombError as error:
        raise broken(f"it promises more than {MOST_PIXELS:,} pixels") from error
    except Exception as error:  # Pillow passes on all errors of the readers of single formats
        raise broken(reason(error)) from error


def _part(width: int, height: int, enough: int) -> int:
    """Return the largest of 8, 4, 2 and 1 that divides both sides and leaves ``enough`` pixels of the longer one."""
    fits = (part for part in (8, 4, 2) if width % part == height % part == 0 and max(width, height) >= part * enough)
    return next(fits, 1)
