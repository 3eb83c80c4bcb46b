"""Match files, entries and prompts to photos by the photo's path below the folder of all photos."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import TypeVar

from beags_plugin.data.files import IMAGE_SUFFIXES
from beags_plugin.system.errors import UserError

Value = TypeVar("Value")


class PhotoNames:
    """The names of V photos of ``data.files.photo_names``, and the photos that other names refer to.

    A name refers to the photo of that name, else to those whose names end with it, or with which it ends. Whole parts
    of the path are compared: "v1" and "images/left/v1" refer to "left/v1", "right/v1" does not.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self.names = list(names)
        self._exact = {name: index for index, name in enumerate(self.names)}
        self._of_stem: dict[str, list[int]] = {}
        for index, name in enumerate(self.names):
            self._of_stem.setdefault(_stem(name), []).append(index)

    def candidates(self, name: str) -> list[int]:
        """Return the indices of the photos that ``name``, with or without suffix, may refer to."""
        for key in _keys(name):
            if key in self._exact:
                return [self._exact[key]]
            same_stem = self._of_stem.get(_stem(key), [])
            if matches := [
                i for i in same_stem if f"/{self.names[i]}".endswith(f"/{key}") or key.endswith(f"/{self.names[i]}")
            ]:
                return matches
        return []

    def in_other_folders(self, name: str) -> list[int]:
        """Return the indices of the photos of the same stem, if the folder in ``name`` excludes all of them."""
        if self.candidates(name):
            return []
        return next((self._of_stem[stem] for stem in map(_stem, _keys(name)) if stem in self._of_stem), [])

    def find(self, name: str, whose: str) -> int | None:
        """Return the index of the photo that ``name`` refers to, or None.

        whose: file that gives the name, for errors. Raises ``UserError`` for several photos, or another folder.
        """
        candidates = self.candidates(name)
        if len(candidates) > 1:
            raise UserError(
                f"{whose} names the view {name!r}, which could be {self._listed(candidates)}: give more of its path."
            )
        if others := self.in_other_folders(name):
            raise UserError(
                f"{whose} names the view {name!r}, but the photo of that name is {self._listed(others)}: correct the "
                "folder."
            )
        return candidates[0] if candidates else None

    def assigned(self, values: Mapping[str, Value], describe: Callable[[Value], str]) -> dict[int, Value]:
        """Return the values whose names refer to a photo, by its index.

        values: by name. describe: names a value's file, for errors.
        Raises ``UserError`` if a name refers to several photos or another folder, unless these photos have values by
        their exact names; and if two names refer to one photo, unless exactly one of them is exact.
        """
        by_exact_name: dict[int, Value] = {}
        by_similar_name: dict[int, Value] = {}
        for name in sorted(values, key=lambda name: plain(name) not in self._exact):  # exact names come first
            value, exact = values[name], plain(name) in self._exact
            places = self.candidates(name)
            others = self.in_other_folders(name)
            if not exact and all(place in by_exact_name for place in places or others):
                continue
            if others:
                raise UserError(
                    f"{describe(value)} has the name of {self._listed(others)} but not the folder: give it the photo's "
                    "own path if it belongs to it, else remove it."
                )
            if len(places) > 1:
                raise UserError(
                    f"{describe(value)} could belong to {self._listed(places)}: give it the path that its photo has "
                    f"below the folder of photos, as {self.names[places[0]]}."
                )
            taken = by_exact_name if exact else by_similar_name
            if places[0] in taken:
                raise UserError(
                    f"{describe(taken[places[0]])} and {describe(value)} could both belong to "
                    f"{self.names[places[0]]}: remove one of them."
                )
            taken[places[0]] = value
        return dict(sorted({**by_similar_name, **by_exact_name}.items()))

    def _listed(self, places: Sequence[int]) -> str:
        names = [self.names[place] for place in places]
        if len(names) > 3:
            return f"{names[0]} or {len(names) - 1} others"
        return " or ".join(filter(None, (", ".join(names[:-1]), names[-1])))


def plain(name: str) -> str:
    """Return a path with slashes and without the suffix of an image."""
    path = PurePosixPath(name.replace("\\", "/"))
    return (path.with_suffix("") if path.suffix.lower() in IMAGE_SUFFIXES else path).as_posix()


def files_by_name(folder: Path) -> dict[str, Path]:
    """Find the images below a folder, by their paths without the suffix.

    Raises ``UserError`` if two differ only in the suffix.
    """
    files: dict[str, Path] = {}
    for path in sorted(folder.rglob("*")):
        ending = next((end for end in IMAGE_SUFFIXES if path.name.lower().endswith(end)), None)
        if ending is not None and path.is_file():
            name = path.relative_to(folder).as_posix()[: -len(ending)]
            if name in files:
                raise UserError(f"{files[name]} and {path} are two files for {name}: remove one of them.")
            files[name] = path
    return files


def _keys(name: str) -> tuple[str, str]:
    """Return a name without the suffix of an image, and the whole name, as a stem may contain dots."""
    return plain(name), PurePosixPath(name.replace("\\", "/")).as_posix()


def _stem(name: str) -> str:
    return name.rpartition("/")[2]
