"""Which photo a file, an entry or a prompt is about: by the photo's path below the folder of all photos."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import TypeVar

from beags_plugin.data.files import IMAGE_SUFFIXES
from beags_plugin.system.errors import UserError

Found = TypeVar("Found")


class PhotoNames:
    """The names of V photos, as ``data.files.photo_names`` gives them, and what other names may mean.

    A name means the photo that is called so; else those whose names end with it, or that it ends with (whole parts of
    the path count: "v1" and "images/left/v1" mean "left/v1", "right/v1" does not).
    """

    def __init__(self, names: Sequence[str]) -> None:
        self.names = list(names)
        self._exact = {name: index for index, name in enumerate(self.names)}
        self._of_stem: dict[str, list[int]] = {}
        for index, name in enumerate(self.names):
            self._of_stem.setdefault(_stem(name), []).append(index)

    def candidates(self, name: str) -> list[int]:
        """The places of the photos that ``name`` (with or without the suffix of an image) may mean."""
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
        """The places of the photos of the same stem, if ``name`` means none because of the folder that it gives."""
        if self.candidates(name):
            return []
        return next((self._of_stem[stem] for stem in map(_stem, _keys(name)) if stem in self._of_stem), [])

    def find(self, name: str, whose: str) -> int | None:
        """The place of the photo that ``name`` means, or None.

        whose: what names it, for errors. Raises ``UserError`` if it may mean several, or gives a photo another folder.
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

    def assigned(self, values: Mapping[str, Found], told: Callable[[Found], str]) -> dict[int, Found]:
        """Place of a photo to the value whose name means it; others mean none.

        values: by name. told: calls a value by its file, for errors.
        Raises ``UserError`` where a name may mean several photos that no other name means exactly, or gives such a
        photo another folder, and where two names mean one photo and not just one of them is its own.
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
                    f"{told(value)} has the name of {self._listed(others)} but not the folder: give it the photo's own "
                    "path if it belongs to it, else remove it."
                )
            if len(places) > 1:
                raise UserError(
                    f"{told(value)} could belong to {self._listed(places)}: give it the path that its photo has below "
                    f"the folder of photos, as {self.names[places[0]]}."
                )
            taken = found if own else loosely
            if places[0] in taken:
                raise UserError(
                    f"{told(taken[places[0]])} and {told(value)} could both belong to {self.names[places[0]]}: remove "
                    "one of them."
                )
            taken[places[0]] = value
        return dict(sorted({**loosely, **found}.items()))

    def _listed(self, places: Sequence[int]) -> str:
        names = [self.names[place] for place in places]
        if len(names) > 3:
            return f"{names[0]} or {len(names) - 1} others"
        return " or ".join(filter(None, (", ".join(names[:-1]), names[-1])))


def plain(name: str) -> str:
    """A path with slashes and without the suffix of an image."""
    path = PurePosixPath(name.replace("\\", "/"))
    return (path.with_suffix("") if path.suffix.lower() in IMAGE_SUFFIXES else path).as_posix()


def files_by_name(folder: Path, endings: Sequence[str] = IMAGE_SUFFIXES) -> dict[str, Path]:
    """The files in a folder and below that end so, by their paths in it without these endings.

    Raises ``UserError`` where two differ in their endings only.
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
    """How a name may be meant: without the suffix of an image, or whole, as a stem may hold dots."""
    return plain(name), PurePosixPath(name.replace("\\", "/")).as_posix()


def _stem(name: str) -> str:
    return name.rpartition("/")[2]
