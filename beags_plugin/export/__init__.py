"""Exporters, in a registry of lazy specs (entry points: ``beags.exporters``)."""

from beags_plugin.system.registry import Registry

EXPORTERS = Registry(
    "exporter",
    "beags.exporters",
    {
        "ply": "beags_plugin.export.splats:PlyExporter",
        "ply-2dgs": "beags_plugin.export.splats:SurfelPlyExporter",
        "compressed-ply": "beags_plugin.export.compressed_ply:CompressedPlyExporter",
        "sog": "beags_plugin.export.sog:SogExporter",
        "splat": "beags_plugin.export.splats:SplatExporter",
        "spz": "beags_plugin.export.spz:SpzExporter",
        "gltf-splats": "beags_plugin.export.gltf_splats:GltfSplatsExporter",
        "gltf-both": "beags_plugin.export.gltf_splats:GltfBothExporter",
        "usdz-splats": "beags_plugin.export.usd_splats:UsdzSplatsExporter",
        "usda-splats": "beags_plugin.export.usd_splats:UsdaSplatsExporter",
        "html": "beags_plugin.export.web_page:WebPageExporter",
        "glb": "beags_plugin.export.mesh:GlbExporter",
        "usdz": "beags_plugin.export.usdz:UsdzExporter",
        "obj": "beags_plugin.export.mesh:ObjExporter",
        "stl": "beags_plugin.export.printing:StlExporter",
        "3mf": "beags_plugin.export.printing:ThreeMfExporter",
    },
)
