"""Names of the classes in the masks of a data set."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from beags_plugin.labels.class_ids import BACKGROUND, IGNORE
from beags_plugin.labels.classes import palette_of, read_classes, read_id_mask
from beags_plugin.labels.id_checks import check_ids, check_palettes
from beags_plugin.system.errors import UserError


def read_class_names(
    classes_file: Path,
    masks: Sequence[Path],
    ignore_ids: Sequence[int],
    known: Mapping[int, str] | None = None,
    known_file: Path | None = None,
) -> dict[int, str]:
    """Return the class names by ascending id: of ``classes_file``, else ``known``, else ``class_<id>``.

    masks: id images, each read once. known, known_file: names of the layout, and their file.
    Raises ``UserError`` if names are given but a mask holds an id without one, and for masks that look spoilt
    (``labels.id_checks``).
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
