"""The plane that exported objects of a run stand on, and their size."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.core.lifting import lift
from beags_plugin.core.surfels import Surfels
from beags_plugin.data.files import image_size
from beags_plugin.export.pose_options import KnownLength, PhotoPoint, Point
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.objects.shown import ShownScene
from beags_plugin.rasterizers.rendering import geometry_inputs, surface_depth
from beags_plugin.runs.run import Run
from beags_plugin.surfaces.frames import Frame, bounding_box
from beags_plugin.surfaces.ground_plane import Plane, standing_plane
from beags_plugin.surfaces.item import NothingToExport
from beags_plugin.system.errors import UserError, meant
from beags_plugin.views.run_data import RunData, Split
from beags_plugin.views.split_photos import SplitPhotos
from beags_plugin.views.views import unique_names

_VIEWS = 24  # most views that are lifted to find a plane
_POINTS = 4000  # most points of each view


def plane_under(name: str, part: Surfels, class_id: int, shown: ShownScene, frame: Frame) -> Plane:
    """Return the plane that an object stands on, in ``frame``.

    part: its Gaussians, in the run's frame. Raises ``NothingToExport`` if the training views show none.
    """
    low, high = bounding_box(frame.surfels(part))
    middle, reach = (low + high) / 2, float((high - low).max())
    around, own, ups = [], [], []
    views = shown.views
    for view in range(0, len(views.cameras), -(-len(views.cameras) // _VIEWS)):
        camera, labels, depth = frame.camera(views.cameras[view]), views.labels[view], views.depths[view]
        points = lift(depth.double() / frame.scale, camera.to(torch.float64))
        seen = (depth > 0) & ((points - middle).abs().amax(dim=-1) < 2 * reach)
        ups.append(-camera.rotation[1].double())
        for mask, chosen in (
            (seen & (labels == class_id), own),
            (seen & (labels != class_id) & (labels != IGNORE), around),
        ):
            inside = points[mask]
            chosen.append(inside[:: max(1, len(inside) // _POINTS)])
    plane = standing_plane(torch.cat(around), torch.cat(own), torch.stack(ups).mean(dim=0))
    if plane is None:
        raise NothingToExport(
            f"the views show no plane that {name!r} stands on: name the direction that is up, such as --up 0,0,1."
        )
    return plane


def metres_per_unit(length: KnownLength, run: Run, world: Frame) -> float:
    """Return the metres in a unit of ``world``, from a known length in it.

    Raises ``UserError`` for a photo or pixel that does not exist, and for points that coincide.
    """
    first, second = (_place(point, run, world) for point in (length.first, length.second))
    apart = float((first - second).norm())
    if not apart > 0:
        raise UserError("the two points of scale_by are the same: give two that are apart.")
    return length.metres / apart


def _place(point: Point, run: Run, world: Frame) -> Tensor:
    """Return the place [3] float64 of a point in ``world``."""
    if not isinstance(point, PhotoPoint):
        return torch.tensor(point, dtype=torch.float64)
    camera, x, y = _pixel(point, run.views("test"))
    surfels = run.scene.surfels().detach()
    render = run.rasterizer.rasterize(geometry_inputs(surfels), camera, run.settings, surfels.means.new_zeros(3))
    depth = float(surface_depth(render, "median")[int(y), int(x)])
    if not depth > 0:
        raise UserError(f"nothing solid is at {point.view}:{point.x:g},{point.y:g}: choose another pixel of scale_by.")
    ray = torch.linalg.solve(camera.K.double(), torch.tensor([x, y, 1.0], dtype=torch.float64))
    in_run = camera.rotation.double().T @ (depth * ray - camera.translation.double())
    return world.points(in_run[None])[0]


def _pixel(point: PhotoPoint, manager: RunData) -> tuple[Camera, float, float]:
    """Return the camera of a photo without lens distortion, and the place of its file's pixel in it, (x, y).

    Pixel centres are at + 0.5.
    """
    datasets: dict[Split, SplitPhotos] = {"train": manager.train_dataset, "eval": manager.eval_dataset}
    files: dict[Path, tuple[Split, int]] = {}  # both splits are the same without held-out photos
    for split, dataset in datasets.items():
        for index, file in enumerate(dataset.image_filenames):
            files.setdefault(Path(file), (split, index))
    by_name = dict(zip(unique_names(list(files)), files, strict=True))
    same = [name for name, file in by_name.items() if file.name == point.view]
    names = [point.view] if point.view in by_name else same
    if not names:
        known = list(by_name)
        raise UserError(f"no photo is called {point.view!r}{meant(point.view, known)}: name one such as {known[0]}.")
    if len(names) > 1:
        raise UserError(f"{len(names)} photos are called {point.view!r}: name one of {', '.join(names)}.")
    file = by_name[names[0]]
    split, index = files[file]
    width, height = image_size(file)
    if not (-0.5 <= point.x < width - 0.5 and -0.5 <= point.y < height - 0.5):
        raise UserError(f"{point.view} has {width} x {height} pixels: {point.x:g},{point.y:g} is not one.")
    share = torch.tensor([(point.x + 0.5) / width, (point.y + 0.5) / height], dtype=torch.float64)
    camera, straight = manager.files[split].straightened(share.numpy()[None], index)
    x, y = straight[0].tolist()
    if not (0 <= x < camera.width and 0 <= y < camera.height):
        raise UserError(
            f"{point.view}:{point.x:g},{point.y:g} lies outside of the photo without its lens distortion: "
            "choose another pixel of scale_by."
        )
    return camera, x, y
