"""Cells of one object of a run alone, before and after refinement, in held-out views and from hidden sides."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera, cropped
from beags_plugin.core.lifting import project
from beags_plugin.core.surfels import Surfels
from beags_plugin.evaluation.records import EvalView
from beags_plugin.evaluation.truths import extracted_truth
from beags_plugin.labels.class_ids import resize_nearest
from beags_plugin.pictures.cells import GAP, Square, as_bytes, below, beside, cell, checkerboard, square_around
from beags_plugin.pictures.orbit import OrbitFrame, least_shown, orbit_frame, orbit_settings, shows, side, view_from
from beags_plugin.rasterizers.interface import Rasterizer, RasterSettings
from beags_plugin.rasterizers.rendering import surfel_inputs
from beags_plugin.surfaces.frames import bounding_box

COLUMNS = 6  # cells in a line with all its pictures
SMALLEST, LARGEST = 300, 480  # bounds for the side of a cell of such a line, pixels
FAINT = 0.1  # alpha from which a stray Gaussian widens the crop
STRAYS = 1.3  # most that strays of earlier stages widen the crop of the last one, times its side
_VIEWS = 2  # views in a line, each with photo, before and after
_PROBE, _ROOM = 160, 3.0  # pixels, and sides of the object's box, of the search for stray Gaussians
_BELOW, _LEVEL = -30.0, 10.0  # degrees above the horizon


@dataclass(frozen=True)
class Drawing:
    """Rasterizer of a sheet; settings: the scene's, for colours only."""

    rasterizer: Rasterizer
    settings: RasterSettings


@dataclass(frozen=True)
class _Shot:
    """A square picture of an object. camera: at the resolution of the photo's file. photo: [h, w, 3] uint8, or None
    without a photo from there."""

    caption: str
    camera: Camera
    settings: RasterSettings
    photo: np.ndarray | None = None


@dataclass(frozen=True)
class ObjectShots:
    """The pictures to render of an object. stages: caption to its Gaussians alone. in_views, sides: the pictures in
    held-out views and from hidden sides. pixels: side of the renders at the resolution of the photos' files."""

    name: str
    stages: Mapping[str, Surfels]
    in_views: Sequence[_Shot]
    sides: Sequence[_Shot]
    pixels: int

    def cells(self, size: int, drawing: Drawing) -> np.ndarray:
        """Return [H, W, 3] uint8: a line of held-out views and one of sides, as wide as ``COLUMNS`` cells of ``size``.

        A line with fewer cells has larger ones, so that it is full.
        """
        width = COLUMNS * (size + GAP)
        return below([beside(self._line(shots, width, drawing)) for shots in (self.in_views, self.sides) if shots])

    def _line(self, shots: Sequence[_Shot], width: int, drawing: Drawing) -> list[np.ndarray]:
        """Return the cells of some pictures, which fill a line of ``width`` pixels."""
        photos = sum(shot.photo is not None for shot in shots)
        size = filling(photos + len(shots) * len(self.stages), width)
        cells = []
        for shot in shots:
            if shot.photo is not None:
                cells.append(cell(shot.photo, (size, size), f"{self.name}, {shot.caption}"))
            for stage, surfels in self.stages.items():
                camera = _sized(shot.camera, min(self.pixels, size))
                image = alone(surfels, camera, shot.settings, drawing.rasterizer)
                caption = f"{shot.caption}: {stage}" if shot.photo is None else stage
                cells.append(cell(over_board(image, size), (size, size), caption))
        return cells


def filling(count: int, width: int) -> int:
    """Return the width of ``count`` cells that fill a line, at most half of it."""
    return width // max(count, 2) - GAP


def cell_size(objects: Sequence[ObjectShots]) -> int:
    """Return one side for the cells of all full lines of a sheet: the median of the objects' sides, within bounds."""
    sides = [min(each.pixels, LARGEST) for each in objects]
    return max(round(float(np.median(sides))), SMALLEST) if sides else LARGEST


def object_shots(
    class_id: int,
    name: str,
    stages: Mapping[str, Surfels],
    views: Sequence[EvalView],
    cameras: Sequence[Camera],
    drawing: Drawing,
) -> ObjectShots:
    """Return the pictures to render of an object, at the resolution of the photos' files.

    The first line has up to two held-out photos from sides far apart, each with the object at every stage. The second
    has two sides from below the horizon and the side that photos show least. Crops hold everything that is rendered of
    the last stage, also strays; those of earlier stages widen them by at most ``STRAYS``.

    stages: caption to the object's Gaussians alone; the last one with any defines its place. views: held-out views;
    those that do not show the object are left out. cameras: cameras of the training photos.
    """
    place = next(each for each in reversed(list(stages.values())) if len(each))
    stand = orbit_frame(*bounding_box(place), cameras)
    in_views = [_in_view(views[each], class_id, stages, drawing) for each in views_of(stand, views)]
    pixels = max((shot.camera.width for shot in in_views), default=LARGEST)
    back = least_shown(stand, cameras, _LEVEL)
    sides = {
        "from below": side(stand, 0.0, _BELOW),
        "from below, behind": side(stand, 180.0, _BELOW),
        "least shown side": side(stand, back, _LEVEL),
    }
    from_sides = [_from_side(stand, caption, away, pixels, stages, drawing) for caption, away in sides.items()]
    return ObjectShots(name, stages, in_views, from_sides, pixels)


def views_of(stand: OrbitFrame, views: Sequence[EvalView]) -> list[int]:
    """Return the indices of at most two views of an object from sides far apart, which show all of it if possible.

    The first is the view that shows it largest.
    """
    whole: dict[int, tuple[int, float]] = {}
    for index, view in enumerate(views):
        if shows(view.camera, stand.center):
            corners = sum(shows(view.camera, corner) for corner in stand.corners)
            _, z = project(stand.center[None], view.camera)
            whole[index] = corners, view.camera.focal / (float(z[0]) * view.camera.width)
    if not whole:
        return []
    most = max(corners for corners, _ in whole.values())
    best = [index for index, (corners, _) in whole.items() if corners == most]
    chosen = [max(best, key=lambda index: whole[index][1])]
    aways = {i: torch.nn.functional.normalize(views[i].camera.center.double() - stand.center, dim=0) for i in whole}
    rest = [index for index in (best if len(best) >= _VIEWS else whole) if index not in chosen]
    return [*chosen, *sorted(rest, key=lambda index: float(aways[index] @ aways[chosen[0]]))[: _VIEWS - 1]]


def alone(surfels: Surfels, camera: Camera, settings: RasterSettings, rasterizer: Rasterizer) -> np.ndarray:
    """Return Gaussians rendered alone, [H, W, 4] uint8, straight alpha."""
    if len(surfels) == 0:
        return np.zeros((camera.height, camera.width, 4), dtype=np.uint8)
    settings = replace(settings, geometry=False, distortion=False)
    with torch.no_grad():
        render = rasterizer.rasterize(
            surfel_inputs(surfels.detach(), camera), camera, settings, surfels.means.new_zeros(3)
        )
    alpha = render.alpha[..., None]
    # Alpha below 1/255 becomes 0, so this bound only keeps the quotient finite.
    return as_bytes(torch.cat([render.color / alpha.clamp(min=1 / 255), alpha], dim=-1))


def over_board(image: np.ndarray, size: int) -> np.ndarray:
    """Return [size, size, 3] uint8: a square [H, H, 4] image, straight alpha, enlarged over a checkerboard."""
    large = np.stack([resize_nearest(image[..., i], size, size) for i in range(4)], axis=-1).astype(np.float64)
    board = checkerboard(size, size, 8)[..., None]
    alpha = large[..., 3:] / 255
    return (large[..., :3] * alpha + board * (1 - alpha)).round().astype(np.uint8)


def _in_view(view: EvalView, class_id: int, stages: Mapping[str, Surfels], drawing: Drawing) -> _Shot:
    """Return the square of a view, at the resolution of its file, around the object at all stages and in truth."""
    truth, size = extracted_truth(view, class_id), (view.camera.height, view.camera.width)
    mask = np.zeros(size, dtype=bool) if truth is None else resize_nearest(truth.mask.cpu().numpy(), *size)
    window = _shown(mask, view.camera, drawing.settings, stages, drawing.rasterizer)
    full = view.camera if view.full is None else view.full.camera
    ratio = full.width / view.camera.width
    top, left, length = (round(ratio * each) for each in window)
    camera = cropped(full, left, top, length, length)
    return _Shot(view.name, camera, drawing.settings, _photo(view, full, (top, left, length)))


def _shown(
    mask: np.ndarray, camera: Camera, settings: RasterSettings, stages: Mapping[str, Surfels], rasterizer: Rasterizer
) -> Square:
    """Return the square around the pixels of ``mask`` [H, W] bool and what the object covers.

    All that it covers at the last stage with any Gaussians is in it; earlier stages widen it by at most ``STRAYS``.
    """
    *earlier, last = [each for each in stages.values() if len(each)]
    covered = [alone(each, camera, settings, rasterizer)[..., 3] > 255 * FAINT for each in (*earlier, last)]
    whole = mask | covered[-1]
    if not whole.any():
        return square_around(np.logical_or.reduce(covered))
    top, left, length = square_around(whole)
    room = round((STRAYS - 1) / 2 * length)
    near = np.zeros_like(whole)
    near[max(top - room, 0) : top + length + room, max(left - room, 0) : left + length + room] = True
    return square_around(np.logical_or.reduce([whole, *(each & near for each in covered[:-1])]))


def _photo(view: EvalView, full: Camera, window: Square) -> np.ndarray | None:
    """Return the window of the photo's file, [length, length, 3] uint8; white outside of the photo."""
    top, left, length = window
    x0, y0, x1, y1 = max(left, 0), max(top, 0), min(left + length, full.width), min(top + length, full.height)
    if view.image is None or x0 >= x1 or y0 >= y1:
        return None
    part = view.image[y0:y1, x0:x1] if view.full is None else view.full.region((x0, y0, x1, y1))[1]
    picture = np.full((length, length, 3), 255, dtype=np.uint8)
    picture[y0 - top : y1 - top, x0 - left : x1 - left] = as_bytes(part)
    return picture


def _from_side(
    stand: OrbitFrame, caption: str, away: Tensor, pixels: int, stages: Mapping[str, Surfels], drawing: Drawing
) -> _Shot:
    """Return the square around everything that the object covers from a side, also strays."""
    probe, settings = view_from(stand, away, _PROBE, _ROOM), orbit_settings(stand)
    top, left, length = _shown(np.zeros((_PROBE, _PROBE), dtype=bool), probe, settings, stages, drawing.rasterizer)
    return _Shot(caption, _sized(cropped(probe, left, top, length, length), pixels), settings)


def _sized(camera: Camera, pixels: int) -> Camera:
    """Return a square camera with the same picture in ``pixels`` x ``pixels``."""
    if camera.width == pixels:
        return camera
    factor = camera.K.new_tensor([[pixels / camera.width], [pixels / camera.width], [1.0]])
    return Camera(camera.viewmat, camera.K * factor, pixels, pixels)
