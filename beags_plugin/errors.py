"""Errors that a user can mend."""

from __future__ import annotations

import errno
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


class UserError(Exception):
    """A mistake in the input, told in one sentence: which file or value, what is wrong, what to do.

    Command lines print the sentence alone, without a traceback, and end with exit code 2.

    told: whether it has been printed already, by the trainer for the command that started it.
    """

    told = False


def system_error(error: BaseException) -> OSError | None:
    """What the operating system refused, if that is why ``error`` was raised: torch hides it behind its own errors."""
    seen: set[int] = set()
    at: BaseException | None = error
    while at is not None and id(at) not in seen:
        if isinstance(at, OSError):
            return at
        seen.add(id(at))
        at = at.__cause__ or at.__context__
    return None


def unwritable(path: str | Path, error: OSError) -> UserError:
    """The sentence for a file or folder that the system does not let us write."""
    reason = error.strerror or error
    remedy = "free some space, or choose another place" if error.errno in _FULL else "choose another place"
    return UserError(f"{path} cannot be written ({reason}): {remedy}.")


@contextmanager
def writing(path: str | Path, what: str = "") -> Iterator[None]:
    """Tell what the system refuses in the block as a ``UserError`` about ``path``, a file or the folder of many.

    what: stands before the path in the sentence. What is refused of a file elsewhere, as when one is read, passes.
    """
    try:
        yield
    except UserError:
        raise
    except Exception as error:
        cause = system_error(error)
        named = None if cause is None else cause.filename
        own = Path(path).absolute().parent
        if cause is None or (isinstance(named, str) and not Path(named).absolute().is_relative_to(own)):
            raise
        raise unwritable(f"{what}{path}", cause) from error


def refused(error: OSError) -> UserError | None:
    """The sentence for what no other place has told; None for an error that names no file and is of no full disk."""
    if error.filename is not None:
        return UserError(f"{error.filename} cannot be used ({error.strerror}): check that it is there and permitted.")
    if error.errno in _FULL:
        return UserError(f"a file cannot be written ({error.strerror}): free some space, also for temporary files.")
    return None


def print_user_errors_plainly() -> None:
    """Let a ``UserError`` that nobody catches print its sentence instead of a traceback, in programs that are not ours.

    The program then ends with exit code 2.

    Calling it again changes nothing; other exceptions go where they went before.
    """
    former = sys.excepthook
    if getattr(former, "prints_user_errors", False):
        return

    def hook(kind, error, traceback) -> None:
        if isinstance(error, UserError):
            print(f"beags: {error}", file=sys.stderr)
            raise SystemExit(2)  # the interpreter, which would end with 1, takes the code of this
        else:
            former(kind, error, traceback)

    hook.prints_user_errors = True  # type: ignore[attr-defined]
    sys.excepthook = hook
