"""Which photo a file, an entry or a prompt is about: by the photo's path below the folder of all photos."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import TypeVar

from beags_plugin.data.files import IMAGE_SUFFIXES
from beags_plugin.errors import UserError

Found = TypeVar("Found")


class PhotoNames:
    """The names of V photos, as ``data.files.photo_names`` gives them, and what other names may mean.

    A name means the photo that is called so; else one whose name ends with it, or that it ends with (whole parts of
    the path count: "v1" and "images/left/v1" mean "left/v1"); else one of the same stem.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self.names = list(names)
        self._exact = {name: index for index, name in enumerate(self.names)}
        self._of_stem: dict[str, list[int]] = {}
        for index, name in enumerate(self.names):
            self._of_stem.setdefault(name.rpartition("/")[2], []).append(index)

    def candidates(self, name: str) -> list[int]:
        """The places of the photos that ``name`` (with or without the suffix of an image) may mean."""
        for key in (plain(name), PurePosixPath(name.replace("\\", "/")).as_posix()):  # a stem may hold dots
            if key in self._exact:
                return [self._exact[key]]
            alike = self._of_stem.get(key.rpartition("/")[2], [])
            if tails := [
                i for i in alike if f"/{self.names[i]}".endswith(f"/{key}") or key.endswith(f"/{self.names[i]}")
            ]:
                return tails
            if alike:
                return alike
        return []

    def find(self, name: str, whose: str) -> int | None:
        """The place of the photo that ``name`` means, or None; ``UserError`` if it may mean several.

        whose: what names it, for the error.
        """
        found = self.candidates(name)
        if len(found) > 1:
            raise UserError(
                f"{whose} names the view {name!r}, which could be {_listed([self.names[i] for i in found])}: give "
                "more of its path."
            )
        return found[0] if found else None

    def assigned(self, values: Mapping[str, Found], told: Callable[[Found], str]) -> dict[int, Found]:
        """Place of a photo to the value whose name means it; others mean none.

        values: by name. told: calls a value by its file, for errors.
        Raises ``UserError`` where a name may mean several photos that no other name means exactly, or where two names
        mean one photo and neither is its own.
        """
        plainly = {plain(name): value for name, value in values.items()}
        found = {self._exact[name]: value for name, value in plainly.items() if name in self._exact}
        loosely: dict[int, Found] = {}
        for name, value in values.items():
            places = self.candidates(name)
            if plain(name) in self._exact or all(place in found for place in places):
                continue
            if len(places) > 1:
                raise UserError(
                    f"{told(value)} could belong to {_listed([self.names[i] for i in places])}: give it the path that "
                    f"its photo has below the folder of photos, as {self.names[places[0]]}."
                )
            if places[0] in loosely:
                raise UserError(
                    f"{told(loosely[places[0]])} and {told(value)} could both belong to {self.names[places[0]]}: "
                    "remove one of them."
                )
            loosely[places[0]] = value
        return dict(sorted({**found, **loosely}.items()))


def plain(name: str) -> str:
    """A path with slashes and without the suffix of an image."""
    path = PurePosixPath(name.replace("\\", "/"))
    return (path.with_suffix("") if path.suffix.lower() in IMAGE_SUFFIXES else path).as_posix()


def files_by_name(folder: Path, endings: Sequence[str] = IMAGE_SUFFIXES) -> dict[str, Path]:
    """The files in a folder and below that end so, by their paths in it without these endings."""
    found: dict[str, Path] = {}
    for path in sorted(folder.rglob("*")):
        ending = next((end for end in endings if path.name.lower().endswith(end)), None)
        if ending is not None and path.is_file():
            found[path.relative_to(folder).as_posix()[: -len(ending)]] = path
    return found


def _listed(names: Sequence[str]) -> str:
    return f"{', '.join(names[:-1])} or {names[-1]}" if len(names) <= 3 else f"{names[0]} or {len(names) - 1} others"
