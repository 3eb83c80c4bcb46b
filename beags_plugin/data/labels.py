"""Names of the classes that the masks of a scene hold."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.system.errors import UserError


def read_class_names(
    classes_file: Path,
    masks: Sequence[Path],
    ignore_ids: Sequence[int],
    known: Mapping[int, str] | None = None,
    known_file: Path | None = None,
) -> dict[int, str]:
    """Names of the classes, sorted by id: of ``classes_file``, else those ``known``, else ``class_<id>``.

    masks: id images. known, known_file: names that the layout brings, and where they stand.
    Raises ``UserError`` if a mask holds an id without a name where names are given. Reads all masks once.
    """
    from beags_plugin.labels.class_ids import BACKGROUND
    from beags_plugin.labels.classes import read_classes

    with ThreadPoolExecutor(max_workers=4) as pool:  # decoding a .png releases the interpreter
        ids_of_masks = list(pool.map(lambda mask: ids_in_mask(mask, ignore_ids), masks))
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


def ids_in_mask(mask: Path, ignore_ids: Sequence[int]) -> set[int]:
    """The class ids of an id image, without IGNORE."""
    from beags_plugin.labels.classes import read_id_mask

    counts = np.bincount(read_id_mask(mask, ignore_ids).ravel(), minlength=IGNORE + 1)
    return {int(i) for i in np.flatnonzero(counts) if i != IGNORE}
