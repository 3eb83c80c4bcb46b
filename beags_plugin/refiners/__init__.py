"""What happens after assignment, as registered refiners (entry points: ``beags.refiners``)."""

from beags_plugin.system.registry import Registry

REFINERS = Registry(
    "refiner",
    "beags.refiners",
    {
        "bea": "beags_plugin.refiners.bea:BeaRefiner",
        "none": "beags_plugin.refiners.none:NoRefiner",
    },
)
