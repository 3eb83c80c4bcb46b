"""The interface of layouts, and the choice of the layout for a folder."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

from beags_plugin.data import LAYOUTS
from beags_plugin.data.dataset import Dataset
from beags_plugin.system.errors import UserError


class Layout(ABC):
    """Interface of the layouts, each of which recognises and reads one kind of data set.

    title, marks: for messages, the layout's name and the files by which it is recognised. refines: names of more
    general layouts, over which this one takes precedence.
    """

    title: ClassVar[str]
    marks: ClassVar[str]
    refines: ClassVar[tuple[str, ...]] = ()

    @abstractmethod
    def missing(self, root: Path) -> str | None:
        """Return what ``root``, a folder or a .json file, lacks, such as "no poses_bounds.npy"; None for nothing."""

    def recognises(self, root: Path) -> bool:
        """Return whether ``root`` seems to have this layout, if the user named none."""
        return self.missing(root) is None

    @abstractmethod
    def read(self, root: Path, images: Path | None) -> Dataset:
        """Read the data set in ``root``, for which nothing is ``missing``; raise ``UserError``.

        images: the folder of images that the user chose, absolute, or None.
        """


def read_dataset(data: Path, layout: str = "auto", images: Path | None = None) -> Dataset:
    """Read the data set in ``data``, a folder or a transforms .json; see ``find_layout`` and ``Layout.read``."""
    root = data if data.is_dir() else data.parent
    return find_layout(data, layout).read(data, None if images is None else root / images)


def find_layout(data: Path, wanted: str = "auto") -> Layout:
    """Return the layout ``wanted``, or for "auto" the one that ``data`` has.

    Raises ``UserError`` if ``data`` does not exist, lacks files of that layout, or has none or several layouts.
    """
    if not data.exists():
        raise UserError(f"the data folder {data} does not exist: give --data the folder that holds the scene.")
    if data.is_file() and data.suffix != ".json":
        raise UserError(f"{data} is neither a folder nor a .json file: give --data the folder that holds the scene.")
    if wanted != "auto":
        layout: Layout = LAYOUTS.get(wanted)()
        if lacks := layout.missing(data):
            raise UserError(
                f"{data} holds {lacks}, which the layout {wanted} needs: correct --data, or choose another layout."
            )
        return layout
    layouts, fitting = _all_layouts(), fitting_layouts(data)
    if not fitting:
        others = ", ".join(
            f"{layout.marks} ({name})" for name, layout in layouts.items() if name not in ("nerfstudio", "colmap")
        )
        raise UserError(
            f"{data} holds neither transforms.json nor a COLMAP model (sparse/0) nor another layout's files, {others}: "
            f"run ns-process-data or COLMAP first, or correct --data."
        )
    if len(fitting) > 1:
        marks = " and ".join(f"{layouts[name].marks} ({name})" for name in fitting)
        raise UserError(f"{data} holds {marks}: choose one of them with beags-data --layout NAME.")
    return layouts[fitting[0]]


def fitting_layouts(data: Path) -> list[str]:
    """Return the names of the layouts that ``data`` may have, without those that another one of them refines."""
    layouts = _all_layouts()
    fitting = {name for name, layout in layouts.items() if layout.recognises(data)}
    return sorted(fitting - {coarser for name in fitting for coarser in layouts[name].refines})


def stem_of(folder: Path, stems: Sequence[str], what: str) -> str:
    """Return the stem of the image that a folder belongs to.

    The folder's name is that stem, or its place in the order of ``stems``, from 0. Raises ``UserError``. what: a word
    for the images, for errors.
    """
    if folder.name in stems:
        return folder.name
    if folder.name.isdigit() and int(folder.name) < len(stems):
        return stems[int(folder.name)]
    raise UserError(f"{folder} is for no {what}, of which there are {len(stems)}: name it 0, 1, ..., or like one.")


def _all_layouts() -> dict[str, Layout]:
    return {name: LAYOUTS.get(name)() for name in LAYOUTS.names()}
