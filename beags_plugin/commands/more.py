"""Commands of other packages: entry points ``beags.commands``, each a dataclass with ``run()``."""

from __future__ import annotations

from collections.abc import Collection
from typing import Annotated, Any

import tyro

from beags_plugin.system.errors import UserError
from beags_plugin.system.registry import Registry

COMMANDS = Registry("command", "beags.commands", {})
KNOWN = {
    "bench": "beags bench is a package of its own: in a clone of beags, call pip install ./benchmarks, or make setup.",
}
"""Commands that a package of ours adds, with the sentence for where it is not installed."""


def more_commands(first: str, taken: Collection[str]) -> list[Any]:
    """Return the commands of other packages, for tyro: that called ``first`` alone if there is one, else all.

    taken: names of our own. Raises ``UserError`` for a name that is taken, a command that cannot be loaded, and one of
    ``KNOWN`` that is not installed.
    """
    names = COMMANDS.names()
    if twice := sorted({*names} & {*taken}):
        raise UserError(
            f"another package adds a command {twice[0]!r}, which beags has already: uninstall that package."
        )
    if first in KNOWN and first not in names:
        raise UserError(KNOWN[first])
    chosen = [first] if first in names else names
    return [Annotated[COMMANDS.get(name), tyro.conf.subcommand(name)] for name in chosen]
