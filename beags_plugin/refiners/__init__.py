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
        "flashsplat": "beags_plugin.refiners.flashsplat:FlashSplatRefiner",
        "cob-gs": "beags_plugin.refiners.cob_gs:CobGsRefiner",
        "trace3d": "beags_plugin.refiners.trace3d:Trace3DRefiner",
        "gaussiancut": "beags_plugin.refiners.gaussiancut:GaussianCutRefiner",
        "gaussian-grouping": "beags_plugin.refiners.gaussian_grouping:GaussianGroupingRefiner",
        "objectgs": "beags_plugin.refiners.objectgs:ObjectGsRefiner",
        "dr-splat": "beags_plugin.refiners.dr_splat:DrSplatRefiner",
        "opengaussian": "beags_plugin.refiners.opengaussian:OpenGaussianRefiner",
        "sagd": "beags_plugin.refiners.sagd:SagdRefiner",
        "instascene": "beags_plugin.refiners.instascene:InstaSceneRefiner",
        "ilgs": "beags_plugin.refiners.ilgs:IlgsRefiner",
        "unified-lift": "beags_plugin.refiners.unified_lift:UnifiedLiftRefiner",
    },
)


def make_refiner(name: str, options: Mapping[str, bool | int | float | str]) -> Refiner:
    """Return the refiner called ``name``; raises ``UserError`` for an unknown name or option, or a wrong value."""
    kind = REFINERS.get(name)
    defaults = {field.name: field.default for field in fields(kind)}
    given: dict[str, bool | int | float | str] = {}
    for option, value in options.items():
        check_choice(option, defaults, "option", f" of the refiner {name}")
        wanted = type(defaults[option])
        given[option] = value = str(value) if wanted is str and type(value) is int else value  # a class may be called 7
        if type(value) is not wanted and not (wanted is float and type(value) is int):
            raise UserError(f"the option {option} of the refiner {name} is {value!r}: give a {wanted.__name__}.")
    return kind(**given)
