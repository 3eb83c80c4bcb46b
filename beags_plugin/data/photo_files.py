"""Find the files of photos that poses name, also for poses written on another machine."""

from __future__ import annotations

import os
import re
import unicodedata
from collections import Counter
from collections.abc import Sequence
from functools import cache
from pathlib import Path, PurePosixPath
from urllib.parse import unquote

from beags_plugin.data.files import IMAGE_SUFFIXES
from beags_plugin.system.errors import UserError

_DRIVE = re.compile(r"^(?:file://)?(?:/?[A-Za-z]:|//[^/]+/[^/]+)(?=/|$)")  # C:/, /C:/ and //server/share


def plain_name(name: str) -> str:
    """Return a name of a file with slashes, without "./" and without the drive of Windows."""
    return PurePosixPath(_DRIVE.sub("", name.replace("\\", "/"))).as_posix()


def without_suffix(name: str) -> str:
    """Return a plain name without an image suffix; other dots belong to the name."""
    suffix = PurePosixPath(name).suffix
    return name.removesuffix(suffix) if suffix.lower() in IMAGE_SUFFIXES else name


class PhotoFinder:
    """Finds files below folders by names that were written elsewhere.

    roots: folders, in order of precedence. A name refers to the file of exactly that path; else to one whose path
    differs in Windows' slashes, case, spaces at its ends, Unicode form or escapes of web addresses, or has no image
    suffix or another one; else to a file whose path below the roots is the end of the name (images/a.jpg for
    C:/scene/images/a.jpg), unless the folder at the beginning of the name exists.
    """

    def __init__(self, roots: Sequence[Path], loose_folders: bool = False) -> None:
        """Open the folders. loose_folders: photos may lie in other folders than named, as smaller copies often do."""
        self.roots, self.loose_folders = list(roots), loose_folders
        self._listed = cache(_listed)

    def find(self, names: Sequence[str]) -> list[Path | None]:
        """Return the file of each name, or None; no file is returned for two names.

        Raises ``UserError`` if two files fit a name.
        """
        files = [self.exact(name) for name in names]
        taken = {path for path in files if path is not None}
        guesses = {index: self.near(name) for index, name in enumerate(names) if files[index] is None}
        uses = Counter(path for path in guesses.values() if path is not None)
        for index, path in guesses.items():
            if path is not None and path not in taken and uses[path] == 1:
                files[index] = path
        return files

    def exact(self, name: str) -> Path | None:
        """Return the file of exactly this name, or None."""
        if "\0" in name:
            return None
        paths = (root / each for root in self.roots for each in (name, name.replace("\\", "/")))
        return next((path for path in paths if path.is_file()), None)

    def near(self, name: str) -> Path | None:
        """Return the file that a name most likely refers to if none has exactly that name, or None."""
        plain = plain_name(name)
        parts = [part for part in PurePosixPath(plain).parts if part.strip("/")]
        if not parts:
            return None
        elsewhere = self.loose_folders or plain.startswith("/")  # a path of another machine
        for root in self.roots:
            if (path := self._below(root, parts)) is not None:
                return path
        if not elsewhere and len(parts) > 1 and any(self._entry(root, parts[0]) is not None for root in self.roots):
            return None
        for start in range(1, len(parts)):
            for root in self.roots:
                if (path := self._below(root, parts[start:])) is not None:
                    return path
        return None

    def _below(self, root: Path, parts: Sequence[str]) -> Path | None:
        folder: Path | None = root
        for part in parts[:-1]:
            if folder is None:
                return None
            folder = folder.parent if part == ".." else self._entry(folder, part)
        return None if folder is None else self._file(folder, parts[-1])

    def _entry(self, folder: Path, name: str) -> Path | None:
        entries = self._listed(folder)
        alike = [name] if name in entries else [entry for entry in entries if _folded(entry) == _folded(name)]
        return folder / alike[0] if len(alike) == 1 else None

    def _file(self, folder: Path, name: str) -> Path | None:
        """Find a file by its name in other spelling, without its suffix, or with that of another kind of image."""
        files = [entry for entry in self._listed(folder) if not entry.startswith(".")]
        images = [entry for entry in files if Path(entry).suffix.lower() in IMAGE_SUFFIXES]
        for alike in (
            [entry for entry in files if entry == name],
            [entry for entry in files if _folded(entry) == _folded(name)],
            [entry for entry in images if _folded(Path(entry).stem) == _folded(name)],
            [entry for entry in images if _folded(Path(entry).stem) == _folded(without_suffix(name))],
        ):
            alike = [entry for entry in alike if (folder / entry).is_file()]
            if len(alike) > 1:
                raise UserError(
                    f"{folder / name} does not exist, and {folder / alike[0]} or {folder / alike[1]} could stand for "
                    "it: remove one of them."
                )
            if alike:
                return folder / alike[0]
        return None


def _listed(folder: Path) -> list[str]:
    try:
        return sorted(os.listdir(folder))
    except OSError:
        return []


def _folded(name: str) -> str:
    return unicodedata.normalize("NFC", unquote(name)).casefold().strip()


def missing_note(missing: Sequence[Path], total: int, source: Path, strict: bool) -> str | None:
    """Return a sentence on missing photos; None without any.

    missing: the paths where they should be. total: number of photos that ``source``, the file of the poses, names.
    Raises ``UserError`` if more than half are missing, or any with ``strict``.
    """
    if not missing:
        return None
    count = "all" if len(missing) == total else str(len(missing))
    are = "is" if len(missing) == 1 else "are"
    what = f"{count} of the {total} photos that {source} names {are} missing"
    first = "" if len(missing) == 1 else "the first of them "
    if strict or 2 * len(missing) > total:
        them = "it" if len(missing) == 1 else "them"
        raise UserError(f"{what}, {first}{missing[0]}: restore {them}, or name the folder with --images-path.")
    it = "it is" if len(missing) == 1 else "they are"
    return f"{what}, {first}{missing[0]}: {it} left out (beags-data --strict True refuses instead)."
