"""The version of the files that a run consists of."""

from __future__ import annotations

from beags_plugin.system.errors import UserError

CONFIG_FILE = "config.yml"
"""File of a run: its config."""
RUN_FORMAT = 3
"""Written to config.yml; a run of another version is refused."""


def other_format(run: object, found: object = None) -> UserError:
    """Return the error for a run of another version than ours. run: its config.yml; found: its version, if any."""
    age = "a newer" if isinstance(found, int) and found > RUN_FORMAT else "an older"
    return UserError(f"{run} was written by {age} version of beags: train again, or use the version that wrote it.")
