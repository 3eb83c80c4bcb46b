"""Layouts of data sets on disk, registered by name (entry points: ``beags.layouts``)."""

from beags_plugin.system.registry import Registry

LAYOUTS = Registry(
    "layout",
    "beags.layouts",
    {
        "3dovs": "beags_plugin.data.layouts.three_d_ovs:ThreeDOvs",
        "colmap": "beags_plugin.data.layouts.colmap:Colmap",
        "lerf-mask": "beags_plugin.data.layouts.lerf_mask:LerfMask",
        "llff": "beags_plugin.data.layouts.llff:Llff",
        "mipnerf360": "beags_plugin.data.layouts.mipnerf360:MipNerf360",
        "nerfstudio": "beags_plugin.data.layouts.nerfstudio:NerfstudioLayout",
    },
)
