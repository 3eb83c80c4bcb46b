"""Importers of scenes to start from, each registered by name (entry points: ``beags.importers``)."""

from beags_plugin.system.registry import Registry

IMPORTERS = Registry(
    "importer",
    "beags.importers",
    {
        "ply": "beags_plugin.importers.ply:PlyImporter",
        "compressed-ply": "beags_plugin.importers.compressed_ply:CompressedPlyImporter",
        "spz": "beags_plugin.importers.spz:SpzImporter",
        "splat": "beags_plugin.importers.splat:SplatImporter",
        "gltf": "beags_plugin.importers.gltf:GltfImporter",
        "sog": "beags_plugin.importers.sog:SogImporter",
        "checkpoint": "beags_plugin.importers.checkpoint:CheckpointImporter",
        "usd": "beags_plugin.importers.usd:UsdImporter",
    },
)
