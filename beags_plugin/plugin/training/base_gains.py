"""How bright photos that share no tracked points are, as the scene shows it that trains on them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.core.exposure import Gains, gains, sightings
from beags_plugin.export.baking import interpolated
from beags_plugin.export.color import linear_from_srgb
from beags_plugin.labels.class_ids import BACKGROUND, IGNORE
from beags_plugin.plugin.options.pyramid import small_size
from beags_plugin.plugin.training.prepared_files import bar
from beags_plugin.plugin.training.scene_model import SceneModel
from beags_plugin.plugin.views.datamanager import BeagsDataManager
from beags_plugin.plugin.views.dataset import resize_area
from beags_plugin.plugin.views.small_views import small_camera
from beags_plugin.plugin.views.views import View, in_unit_range
from beags_plugin.rasterizers.rendering import geometry_inputs
from beags_plugin.system import processes

MOST_POINTS = 8000  # A larger cloud is thinned to about as many points.
SHORTER_SIDE = 128  # pixels of the renderings
OPAQUE = 0.95  # alpha from which a pixel of a photo shows the scene
SAME_DEPTH = 0.01  # A point may lie beside the rendered surface by this share of its depth.


def point_cloud(datamanager: BeagsDataManager) -> np.ndarray | None:
    """Return the points [P, 3] float64 of the data, in the run's frame; None where seeds are random."""
    metadata = datamanager.train_dataset.metadata
    if metadata["points3D_random"]:
        return None
    points = metadata["points3D_xyz"].double().numpy()
    return points[:: max(1, -(-len(points) // MOST_POINTS))]


@torch.no_grad()
def gains_of_points(
    model: SceneModel, datamanager: BeagsDataManager, points: np.ndarray, views: Sequence[View]
) -> Gains:
    """Return how bright training photos show points [P, 3] that the scene does not hide from them.

    Its depth tells that early in the base; its colours, which follow the photos, play no part.
    """
    background, settings = model.background_color.to(model.device), model.settings()
    inputs = geometry_inputs(model.surfels())

    def seen(index: int) -> tuple[np.ndarray, np.ndarray]:
        view, held = views[index], views[index].data()
        camera = _small(view.camera)
        depth = model.rasterizer.rasterize(inputs, camera, settings, background).median_depth
        assert depth is not None
        ids, xy, z = _projected(points, camera)
        column, row = xy.astype(np.int64).T
        surface = depth.double().cpu().numpy()[row, column]
        shown = (np.abs(surface - z) < SAME_DEPTH * z) & _comparable(view, held, camera, datamanager)[row, column]
        scale = np.array([view.camera.width / camera.width, view.camera.height / camera.height])
        return ids[shown], linear_from_srgb(interpolated(in_unit_range(held["image"]).cpu(), xy[shown] * scale))

    with bar("Comparing exposures", passing=True) as progress:
        ids, light = zip(*processes.each_view(len(views), seen, progress), strict=True)
    return gains(sightings(ids, light), len(views))


def _small(camera: Camera) -> Camera:
    """Return a camera whose image covers that of ``camera`` with fewer pixels."""
    factor = min(camera.width, camera.height) / SHORTER_SIDE
    return small_camera(camera, small_size(camera.width, camera.height, factor))


def _comparable(view: View, held: dict[str, Tensor], camera: Camera, datamanager: BeagsDataManager) -> np.ndarray:
    """Return [H, W] bool, where a photo whose data are ``held`` shows what training sees, in pixels of ``camera``."""
    size = camera.width, camera.height
    comparable = np.ones(size[::-1], dtype=bool)
    if (alpha := held.get("alpha")) is not None:
        comparable &= resize_area(alpha.cpu().numpy() / np.float32(255.0), *size) > OPAQUE
    if datamanager.config.photos == "objects" and (labels := view.labels) is not None:
        inside = (labels != BACKGROUND) & (labels != IGNORE)
        comparable &= resize_area(inside.float().cpu().numpy(), *size) > OPAQUE
    return comparable


def _projected(points: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return which of the points [P, 3] lie inside the image, where, [M, 2] pixels, and their depths [M]."""
    world, calibration = camera.host.viewmat.double().numpy(), camera.host.K.double().numpy()
    local = points @ world[:3, :3].T + world[:3, 3]
    ids = np.flatnonzero(local[:, 2] > 0.0)
    z = local[ids, 2]
    xy = local[ids, :2] / z[:, None] * calibration[[0, 1], [0, 1]] + calibration[:2, 2]
    inside = ((xy >= 0.0) & (xy < [camera.width, camera.height])).all(axis=1)
    return ids[inside], xy[inside], z[inside]
