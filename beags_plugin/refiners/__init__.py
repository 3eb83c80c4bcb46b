"""Refiners of a scene with assigned classes, registered by name (entry points: ``beags.refiners``)."""

from beags_plugin.system.registry import Registry

REFINERS = Registry(
    "refiner",
    "beags.refiners",
    {
        "bea": "beags_plugin.refiners.bea:BeaRefiner",
        "none": "beags_plugin.refiners.none:NoRefiner",
    },
)
