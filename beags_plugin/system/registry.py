"""Registries of lazy ``"module:Class"`` specs, open to other packages through entry points."""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import entry_points
from typing import Any

from beags_plugin.system.errors import UserError, check_choice


def load(spec: str) -> Any:
    """Import what a ``"module:attribute"`` spec names."""
    module, _, attribute = spec.partition(":")
    return getattr(import_module(module), attribute)


class Registry:
    """Names mapped to ``"module:attribute"`` specs; a spec is imported only by ``get``.

    kind: the user's word for an entry ("rasterizer"). group: the entry-point group in which other packages add their
    own, e.g. ``beags.rasterizers``. builtin: name to spec of the entries of this package; an entry point of the same
    name is refused. others: where more entries come from; the message about an unknown name ends with it as long as no
    package has added any.
    """

    def __init__(self, kind: str, group: str, builtin: dict[str, str], others: str = "") -> None:
        self.kind = kind
        self.group = group
        self._specs = dict(builtin)
        self._builtin, self._others = frozenset(builtin), others
        self._discovered = False

    def _discover(self) -> None:
        if self._discovered:
            return
        self._discovered = True
        for point in entry_points(group=self.group):
            self.register(point.name, point.value)

    def register(self, name: str, spec: str) -> None:
        """Add ``name``; raises ``UserError`` if the name is taken by another spec."""
        first = self._specs.setdefault(name, spec)
        if first != spec:
            raise UserError(
                f"two {self.kind}s are called {name!r} ({first} and {spec}): rename or uninstall one of them."
            )

    def names(self) -> list[str]:
        """Return the registered names, sorted; imports none of them."""
        self._discover()
        return sorted(self._specs)

    def check(self, name: str, *besides: str) -> None:
        """Raise ``UserError`` unless ``name`` is registered, or is one of ``besides``; imports nothing."""
        names = self.names()
        check_choice(name, [*besides, *names], self.kind, more=self._others if self._builtin.issuperset(names) else "")

    def get(self, name: str) -> Any:
        """Import and return what ``name`` stands for; raises ``UserError`` for an unknown name or a spec that fails."""
        self.check(name)
        try:
            return load(self._specs[name])
        except (ImportError, AttributeError) as error:
            raise UserError(f"the {self.kind} {name!r} ({self._specs[name]}) cannot be loaded: {error}") from error
