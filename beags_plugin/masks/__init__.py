"""Masks, and reprojections that make them consistent between views (entry points: ``beags.reprojections``)."""

from beags_plugin.system.registry import Registry

REPROJECTIONS = Registry(
    "reprojection",
    "beags.reprojections",
    {
        "pairwise": "beags_plugin.masks.reprojection:reproject_pairwise",
        "voxel": "beags_plugin.masks.voxel_reprojection:reproject_voxel",
    },
)
