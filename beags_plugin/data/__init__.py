"""What data sets look like on disk, as registered layouts (entry points: ``beags.layouts``); nothing of nerfstudio."""

from beags_plugin.registry import Registry

LAYOUTS = Registry(
    "layout",
    "beags.layouts",
    {
        "colmap": "beags_plugin.data.layouts.colmap:Colmap",
        "llff": "beags_plugin.data.layouts.llff:Llff",
        "nerfstudio": "beags_plugin.data.layouts.nerfstudio:NerfstudioLayout",
    },
)
