"""Errors that a user can mend."""


class UserError(Exception):
    """A mistake in the input, told in one sentence: which file or value, what is wrong, what to do.

    Command lines print the sentence alone, without a traceback, and end with exit code 2.
    """
