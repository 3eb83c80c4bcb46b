"""The losses, each a registered component (entry points: ``beags.losses``)."""

from beags_plugin.system.registry import Registry

LOSSES = Registry(
    "loss",
    "beags.losses",
    {
        "photometric": "beags_plugin.losses.photometric:PhotometricLoss",
        "normal": "beags_plugin.losses.normal:NormalConsistencyLoss",
        "distortion": "beags_plugin.losses.distortion:DistortionLoss",
        "boundary": "beags_plugin.losses.boundary:BoundaryLoss",
        "silhouette": "beags_plugin.losses.silhouette:SilhouetteLoss",
        "occupancy": "beags_plugin.losses.occupancy:OccupancyLoss",
    },
)
