"""Matching of files, entries and prompts to photos, by the photo's path below the folder of all photos."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import TypeVar

from beags_plugin.data.files import IMAGE_SUFFIXES
from beags_plugin.system.errors import UserError

Found = TypeVar("Found")


class PhotoNames:
    """The names of V photos of ``data.files.photo_names``, and the photos that other names mean.

    A name means the photo of that name; else those whose names end with it, or that it ends with (in whole parts of the
    path: "v1" and "images/left/v1" mean "left/v1", "right/v1" does not).
    """

    def __init__(self, names: Sequence[str]) -> None:
        self.names = list(names)
        self._exact = {name: index for index, name in enumerate(self.names)}
        self._of_stem: dict[str, list[int]] = {}
        for index, name in enumerate(self.names):
            self._of_stem.setdefault(_stem(name), []).append(index)

    def candidates(self, name: str) -> list[int]:
        """Return the indices of the photos that ``name``, with or without suffix, may mean."""
        for key in _keys(name):
            if key in self._exact:
                return [self._exact[key]]
            alike = self._of_stem.get(_stem(key), [])
            if found := [
                i for i in alike if f"/{self.names[i]}".endswith(f"/{key}") or key.endswith(f"/{self.names[i]}")
            ]:
                return found
        return []

    def in_other_folders(self, name: str) -> list[int]:
        """Return the indices of the photos of the same stem, if the folder in ``name`` excludes all of them."""
        if self.candidates(name):
            return []
        return next((self._of_stem[stem] for stem in map(_stem, _keys(name)) if stem in self._of_stem), [])

    def find(self, name: str, whose: str) -> int | None:
        """Return the index of the photo that ``name`` means, or None.

        whose: source of the name, for errors. Raises ``UserError`` for several photos, or another folder.
        """
        found = self.candidates(name)
        if len(found) > 1:
            raise UserError(
                f"{whose} names the view {name!r}, which could be {self._listed(found)}: give more of its path."
            )
        if others := self.in_other_folders(name):
            raise UserError(
                f"{whose} names the view {name!r}, but the photo of that name is {self._listed(others)}: correct the "
                "folder."
            )
        return found[0] if found else None

    def assigned(self, values: Mapping[str, Found], describe: Callable[[Found], str]) -> dict[int, Found]:
        """Return the photo index of each value whose name means a photo.

        values: by name. describe: names a value's file, for errors.
        Raises ``UserError`` if a name means several photos or another folder, unless exact names take these photos;
        and if two names mean a photo, unless exactly one of them is exact.
        """
        found: dict[int, Found] = {}
        loosely: dict[int, Found] = {}
        for name in sorted(values, key=lambda name: plain(name) not in self._exact):  # photos' own names come first
            value, own = values[name], plain(name) in self._exact
            places = self.candidates(name)
            others = self.in_other_folders(name)
            if not own and all(place in found for place in places or others):
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
            taken = found if own else loosely
            if places[0] in taken:
                raise UserError(
                    f"{describe(taken[places[0]])} and {describe(value)} could both belong to "
                    f"{self.names[places[0]]}: remove one of them."
                )
            taken[places[0]] = value
        return dict(sorted({**loosely, **found}.items()))

    def _listed(self, places: Sequence[int]) -> str:
        names = [self.names[place] for place in places]
        if len(names) > 3:
            return f"{names[0]} or {len(names) - 1} others"
        return " or ".join(filter(None, (", ".join(names[:-1]), names[-1])))


def plain(name: str) -> str:
    """Return a path with slashes and without the suffix of an image."""
    path = PurePosixPath(name.replace("\\", "/"))
    return (path.with_suffix("") if path.suffix.lower() in IMAGE_SUFFIXES else path).as_posix()


def files_by_name(folder: Path, endings: Sequence[str] = IMAGE_SUFFIXES) -> dict[str, Path]:
    """Find the files below a folder with these endings, by their paths without the ending.

    Raises ``UserError`` if two differ only in the ending.
    """
    found: dict[str, Path] = {}
    for path in sorted(folder.rglob("*")):
        ending = next((end for end in endings if path.name.lower().endswith(end)), None)
        if ending is not None and path.is_file():
            name = path.relative_to(folder).as_posix()[: -len(ending)]
            if name in found:
                raise UserError(f"{found[name]} and {path} are two files for {name}: remove one of them.")
            found[name] = path
    return found


def _keys(name: str) -> tuple[str, str]:
    """Return a name without the suffix of an image, and whole, as a stem may contain dots."""
    return plain(name), PurePosixPath(name.replace("\\", "/")).as_posix()


def _stem(name: str) -> str:
    return name.rpartition("/")[2]
