"""Importers of scenes to start from, each a registered component (entry points: ``beags.importers``)."""

from beags_plugin.system.registry import Registry

IMPORTERS = Registry(
    "importer",
    "beags.importers",
    {
        "ply": "beags_plugin.importers.ply:PlyImporter",
        "checkpoint": "beags_plugin.importers.checkpoint:CheckpointImporter",
    },
)
