"""Refiners of a scene with assigned classes, registered by name (entry points: ``beags.refiners``)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import TYPE_CHECKING

from beags_plugin.system.errors import UserError, check_choice
from beags_plugin.system.registry import Registry

if TYPE_CHECKING:
    from beags_plugin.preparation.refiner import Refiner

REFINERS = Registry(
    "refiner",
    "beags.refiners",
    {
        "bea": "beags_plugin.refiners.bea:BeaRefiner",
        "none": "beags_plugin.refiners.none:NoRefiner",
    },
    others="; other papers' methods come with beags-baselines (pip install ./baselines in a clone of beags)",
)


def make_refiner(name: str, options: Mapping[str, bool | int | float | str]) -> Refiner:
    """Return the refiner called ``name``; raises ``UserError`` for an unknown name or option, or a wrong value."""
    kind = REFINERS.get(name)
    defaults = {field.name: field.default for field in fields(kind)}
    given: dict[str, bool | int | float | str] = {}
    for option, value in options.items():
        check_choice(option, defaults, "option", f" of the refiner {name}")
        expected = type(defaults[option])
        if expected is str and type(value) is int:
            value = str(value)  # A class may be named 7.
        if type(value) is not expected and not (expected is float and type(value) is int):
            raise UserError(f"the option {option} of the refiner {name} is {value!r}: give a {expected.__name__}.")
        given[option] = value
    return kind(**given)
