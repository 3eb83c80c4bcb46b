"""Errors that a user can mend."""

from __future__ import annotations

import sys


class UserError(Exception):
    """A mistake in the input, told in one sentence: which file or value, what is wrong, what to do.

    Command lines print the sentence alone, without a traceback, and end with exit code 2.
    """


def print_user_errors_plainly() -> None:
    """Let a ``UserError`` that nobody catches print its sentence instead of a traceback, in programs that are not ours.

    Calling it again changes nothing; other exceptions go where they went before.
    """
    former = sys.excepthook
    if getattr(former, "prints_user_errors", False):
        return

    def hook(kind, error, traceback) -> None:
        if isinstance(error, UserError):
            print(f"beags: {error}", file=sys.stderr)
        else:
            former(kind, error, traceback)

    hook.prints_user_errors = True  # type: ignore[attr-defined]
    sys.excepthook = hook
