"""Errors that a user can repair, and system errors that are turned into them."""

from __future__ import annotations

import errno
import os
import sys
import threading
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from difflib import get_close_matches
from pathlib import Path

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_OF_DISKS = (*_FULL, errno.EIO, errno.EROFS, errno.EACCES, errno.EPERM, errno.ENODEV, errno.ENXIO, errno.ESTALE)
"""Errors that a disk returns for a write into an open file; such an error names no file."""


class UserError(Exception):
    """An error in the input, in one sentence: which file or value, what is wrong, what to do.

    Command lines print the sentence alone, without a traceback, and end with exit code 2.

    reported: the trainer has printed it already; the command that started it need not.
    """

    reported = False


def check_choice(name: str, choices: Iterable[str], kind: str, where: str = "", more: str = "") -> None:
    """Raise ``UserError`` unless ``name`` is one of the choices; the sentence names the nearest.

    kind: the user's word for a choice ("preset"). where: text after the name. more: text after the choices.
    """
    if name in (choices := list(choices)):
        return
    remedy = f"choose one of {', '.join(choices)}" if choices else "leave it out"
    raise UserError(f"there is no {kind} {name!r}{where}{meant(name, choices)}: {remedy}{more}.")


def meant(name: str, choices: Iterable[str]) -> str:
    """Return the choice nearest to an unknown name, as a question in brackets; "" if none is near."""
    folded = {choice.casefold(): choice for choice in choices}
    near = get_close_matches(name.casefold(), folded, n=1, cutoff=0.75)
    return f" (did you mean {folded[near[0]]}?)" if near else ""


def system_error(error: BaseException) -> OSError | None:
    """Return the operating system's error that caused ``error``, if there is one.

    An error that is raised while a system error is handled is not caused by it. torch's writer of files is the
    exception: when the disk is full, it reports that it cannot close the file.
    """
    at: BaseException | None = error
    seen: set[int] = set()
    while at is not None and not isinstance(at, OSError) and id(at) not in seen:
        seen.add(id(at))
        torchs = isinstance(at, RuntimeError) and "inline_container" in str(at)
        at = at.__cause__ or (at.__context__ if torchs else None)
    return at if isinstance(at, OSError) else None


def is_of_disk(error: OSError) -> bool:
    """Return whether a disk refused a write into an open file; other errors that name no file are defects."""
    return error.errno in _OF_DISKS


def unwritable(path: str | Path, error: OSError) -> UserError:
    """Return the error for a file or folder that the system does not let us write."""
    reason = error.strerror or error
    remedy = "free some space, or choose another place" if error.errno in _FULL else "choose another place"
    return UserError(f"{path} cannot be written ({reason}): {remedy}.")


@contextmanager
def writing(path: str | Path, what: str = "") -> Iterator[None]:
    """Turn the system's errors in the block into a ``UserError`` about ``path``, a file or the folder of many.

    what: text before the path in the sentence. Other errors pass: errors of files elsewhere, such as an input that
    cannot be read, and errors without a file, such as a closed pipe.
    """
    try:
        yield
    except UserError:
        raise
    except Exception as error:
        cause = system_error(error)
        if cause is None or not _is_about(Path(path).absolute(), cause):
            raise
        raise unwritable(f"{what}{path}", cause) from error


def _is_about(path: Path, error: OSError) -> bool:
    """Return whether an error names a file beside or below ``path`` or a folder above, or comes from a disk."""
    if isinstance(error.filename, (str, os.PathLike)):
        named = Path(error.filename).absolute()
        return named.is_relative_to(path.parent) or path.is_relative_to(named)
    return is_of_disk(error)


def refused(error: OSError) -> UserError | None:
    """Return the message for a system error that nothing else caught; None if it names no file and no disk is full."""
    if error.filename is not None:
        return UserError(f"{error.filename} cannot be used ({error.strerror}): check that it is there and permitted.")
    if error.errno in _FULL:
        return UserError(f"a file cannot be written ({error.strerror}): free some space, also for temporary files.")
    return None


def silence_libraries() -> None:
    """Hide warnings that are meant for the authors of torch and nerfstudio; for programs that run beags alone.

    Warnings of other code stay. All stay if ``python -W`` or PYTHONWARNINGS asks for some.
    """
    if not all(option.startswith("ignore") for option in sys.warnoptions):
        return
    warnings.filterwarnings("ignore", category=FutureWarning, module=r"(torch|nerfstudio)\.")
    warnings.filterwarnings("ignore", category=UserWarning, module=r"nerfstudio\.")


def print_user_errors_plainly() -> None:
    """Print the sentence of an uncaught ``UserError`` instead of a traceback, in nerfstudio's programs.

    The program then ends with exit code 2. The thread that writes tensorboard's files prints nothing about a full
    disk: it raises the error where the next curve is added. Other exceptions are printed as before.

    Call this when a part of beags is set up, not on import: it changes the process. A second call does nothing.
    """
    former = sys.excepthook
    if getattr(former, "prints_user_errors", False):
        return

    def hook(kind, error, traceback) -> None:
        if isinstance(error, UserError):
            print(f"beags: {error}", file=sys.stderr)
            raise SystemExit(2)  # the interpreter would end with 1
        former(kind, error, traceback)

    hook.prints_user_errors = True  # type: ignore[attr-defined]
    sys.excepthook = hook
    former_of_threads = threading.excepthook

    def thread_hook(args: threading.ExceptHookArgs) -> None:
        reported_elsewhere = type(args.thread).__module__ == "tensorboard.summary.writer.event_file_writer"
        if not (reported_elsewhere and isinstance(args.exc_value, OSError) and is_of_disk(args.exc_value)):
            former_of_threads(args)

    threading.excepthook = thread_hook
