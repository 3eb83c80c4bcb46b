"""The version of the files that a run consists of."""

from __future__ import annotations

CONFIG_FILE = "config.yml"
"""Name of a run's config file."""
RUN_FORMAT = 3
"""Written to config.yml; a run of another version is refused."""
