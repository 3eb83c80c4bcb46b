"""Files that are not the data their names promise: Git LFS or git-annex pointers, web pages, empty or misnamed."""

from __future__ import annotations

import re
from pathlib import Path

from beags_plugin.system.pasted import quoted

_HEAD = 2048  # bytes to look at; a Git LFS pointer has fewer than 1024
_LFS = b"version https://git-lfs.github.com/spec/"
_ANNEX = re.compile(rb"^(?:\.\./|/)*\.?git/annex/objects/|^/annex/objects/")
_XML = re.compile(rb"^\s*<\?xml[^>]*\?>\s*<(?:Error|Code)\b")  # error messages of storage services
_PAGE = re.compile(rb"^\s*(?:<!--.*?-->\s*)*(?:<!doctype\s+html|<html\b|<head\b|<body\b)", re.IGNORECASE | re.DOTALL)
_STARTS = (
    (b"ply\n", "a .ply"), (b"ply\r", "a .ply"), (b"PK\x03\x04", "a zip, as .sog and .usdz are"),
    (b"\x1f\x8b", "packed by gzip, as .spz is"), (b"glTF", "a .glb"), (b"#usda", "a .usda"), (b"PXR-USDC", "a .usdc"),
    (b"\x89PNG", "a PNG"), (b"\xff\xd8\xff", "a JPEG"), (b"7z\xbc\xaf", "packed by 7-Zip"),
    (b"\x28\xb5\x2f\xfd", "packed by zstd"),
)  # fmt: skip


def starts_as(path: Path) -> str | None:
    """Return the format that the first bytes of a file show, for the brackets of a sentence; None if unknown."""
    try:
        with path.open("rb") as file:
            head = file.read(8)
    except OSError:
        return None
    return next((f"it starts as {kind}: unpack or rename it" for mark, kind in _STARTS if head.startswith(mark)), None)


def stand_in(path: Path | str) -> str | None:
    """Return what a file without data is and the remedy, for the brackets of a sentence.

    None for files with data, files that cannot be read, and paths that are no file.
    """
    path = Path(path)
    try:
        if not path.is_file():
            return None
        with path.open("rb") as file:
            head = file.read(_HEAD)
    except OSError:
        return None
    if not head:
        return "it is empty, as after a download that broke off; get it again"
    if head.startswith(_LFS):
        return "it is a pointer of Git LFS, not the file itself; run git lfs pull in its folder"
    if _ANNEX.match(head):
        return f"it is a pointer of git-annex, not the file itself; run git annex get {quoted(path.name)} in its folder"
    if _PAGE.match(head.removeprefix(b"\xef\xbb\xbf")):
        return "it is a web page, not the file itself; open the link in a browser and download the file"
    if _XML.match(head):
        return "it is an error message of the server, not the file itself; download it again"
    return None
