"""Which formats objects can be exported to here."""

from __future__ import annotations

from beags_plugin.export import EXPORTERS
from beags_plugin.export.base import make_exporter
from beags_plugin.system.errors import UserError


def formats_here() -> list[str]:
    """Return the names of the formats whose libraries are installed."""
    found = []
    for name in EXPORTERS.names():
        try:
            make_exporter(name)
        except UserError:
            continue
        found.append(name)
    return found
