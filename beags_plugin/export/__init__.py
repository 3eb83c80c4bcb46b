"""Exporters, each a registered component (entry points: ``beags.exporters``)."""

from beags_plugin.system.registry import Registry

EXPORTERS = Registry(
    "exporter",
    "beags.exporters",
    {
        "ply": "beags_plugin.export.splats:PlyExporter",
        "ply-2dgs": "beags_plugin.export.splats:SurfelPlyExporter",
        "spz": "beags_plugin.export.spz:SpzExporter",
        "glb": "beags_plugin.export.mesh:GlbExporter",
        "obj": "beags_plugin.export.mesh:ObjExporter",
        "stl": "beags_plugin.export.printing:StlExporter",
        "3mf": "beags_plugin.export.printing:ThreeMfExporter",
    },
)
