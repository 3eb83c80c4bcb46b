"""Engines that run the trials of an experiment, by name (entry points: ``beags.engines``)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from beags_plugin.system.errors import UserError
from beags_plugin.system.registry import Registry

if TYPE_CHECKING:
    from beags_benchmarks.experiments.engines.interface import Engine
    from beags_benchmarks.experiments.options import EngineOptions

ENGINES = Registry(
    "engine",
    "beags.engines",
    {
        "local": "beags_benchmarks.experiments.engines.local:LocalEngine",
        "ray": "beags_benchmarks.experiments.engines.ray_cluster:RayEngine",
    },
)


def make_engine(name: str, address: str | None = None) -> Engine:
    """Return the engine called ``name``; raises ``UserError`` for an unknown engine or one that cannot run here.

    address: address of the cluster, for engines that have one.
    """
    kind = ENGINES.get(name)
    if reason := kind.unavailable():
        raise UserError(reason)
    return kind(address)


@contextmanager
def open_engine(options: EngineOptions) -> Iterator[Engine]:
    """Open the engine of the options and close it at the end; a plan opens nothing.

    Raises ``UserError`` for an engine that cannot run here or cannot reach its cluster.
    """
    engine = make_engine(options.engine, options.address)
    if options.plan:
        yield engine
    else:
        with engine:
            yield engine
