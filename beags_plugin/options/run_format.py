"""The version of the files that a run consists of."""

from __future__ import annotations

from beags_plugin.system.errors import UserError

CONFIG_FILE = "config.yml"
"""Name of a run's config file."""
RUN_FORMAT = 3
"""Written to config.yml; a run of another version is refused."""


def other_format(run: object, version: object = None) -> UserError:
    """Return the error for a run of another version than ours. run: its config.yml. version: the one in it, if any."""
    age = "a newer" if isinstance(version, int) and version > RUN_FORMAT else "an older"
    return UserError(f"{run} was written by {age} version of beags: train again, or use the version that wrote it.")
