"""Engines that run the trials of an experiment, by name (entry points: ``beags.engines``)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from beags_plugin.system.errors import UserError
from beags_plugin.system.registry import Registry

if TYPE_CHECKING:
    from beags_plugin.bench.engines.interface import Engine

ENGINES = Registry(
    "engine",
    "beags.engines",
    {"local": "beags_plugin.bench.engines.local:LocalEngine"},
)


def make_engine(name: str, address: str | None = None) -> Engine:
    """Return the engine called ``name``; raises ``UserError`` for an unknown one, and one that cannot run here.

    address: of the cluster, for engines that have one.
    """
    kind = ENGINES.get(name)
    if reason := kind.unavailable():
        raise UserError(reason)
    return kind(address)
