"""Source of masks: objects cut out of a trained scene by prompts, and rendered into all training views."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import ClassVar, Protocol, cast

import numpy as np
import torch
from torch import Tensor

from beags_plugin.core.membership import Membership
from beags_plugin.core.surfels import Surfels
from beags_plugin.labels.class_ids import BACKGROUND, IGNORE
from beags_plugin.masks.sources.base import Geometry, MadeMasks, MaskSource, Photo, Progress, SourceScene
from beags_plugin.masks.sources.prompts import Prompt, PromptedObject, read_prompts
from beags_plugin.picking.cutter import Cutter, ViewMarks, takes_much
from beags_plugin.picking.sight import spread
from beags_plugin.rasterizers.interface import Rasterizer, RasterSettings
from beags_plugin.rasterizers.rendering import draw_features, geometry_inputs
from beags_plugin.system.errors import UserError

MARK = 0.003  # radius of a marked point, over the image diagonal
DRAWN = 0.5  # least share of a pixel's light that an object needs to label it


class TrainedGeometry(Geometry, Protocol):
    """A geometry that also gives its Gaussians, and what they are rendered with."""

    rasterizer: Rasterizer
    settings: RasterSettings

    def surfels(self) -> Surfels:
        """Return the N Gaussians, in the run's frame."""
        ...

    def input_means(self) -> Tensor:
        """Return the centres of the Gaussians, [N, 3] float64, in the frame of the input poses."""
        ...


@dataclass(frozen=True)
class CutSource(MaskSource):
    """Objects cut out of the Gaussians of a run by points, strokes and boxes in one or more views (``picking.cutter``).

    prompts: JSON, see ``prompts.read_prompts``. A point on an object counts as a point beside all others.
    """

    needs_run: ClassVar[bool] = True
    guesses: ClassVar[bool] = True

    prompts: Path = Path("prompts.json")

    def make(self, scene: SourceScene, progress: Progress) -> MadeMasks:
        assert scene.geometry is not None
        path = scene.below(self.prompts)
        objects = read_prompts(path, beside_alone=True)
        geometry = cast(TrainedGeometry, scene.geometry)
        marked = _by_view(scene, objects, path)
        trained = [index for index, place in enumerate(scene.places) if scene.photos[place].trained]
        surfels = geometry.surfels()
        cameras = spread([geometry.cameras[index] for index in trained])
        total = len(cameras) + len(objects) + len(trained)
        cutter = Cutter(surfels, cameras, geometry.rasterizer, geometry.settings, lambda done, _: progress(done, total))
        means = geometry.input_means()
        members, notes = [], []
        for done, one in enumerate(objects, start=1):
            excluded = torch.zeros(len(surfels), dtype=torch.bool)
            for region in one.space:
                excluded |= ~region.contains(means).cpu()
            views = [view_marks(geometry, index, scene, prompts, one) for index, prompts in marked.items()]
            members.append(cutter.solve([marks for each in views for marks in each], excluded, one.name))
            if much := takes_much(members[-1]):
                notes.append(f"The cut of {one.name} takes {much}.")
            progress(len(cameras) + done, total)
        steps = count(len(cameras) + len(objects) + 1)
        names = {0: "background", **{one.class_id: one.name for one in objects}}
        ids = [one.class_id for one in objects]
        maps = _drawn(scene, geometry, ids, torch.stack(members, dim=1), lambda: progress(next(steps), total))
        return MadeMasks(names, maps, notes)


@dataclass(frozen=True)
class DrawnSource(MaskSource):
    """Objects with known Gaussians, rendered into all training views as ``CutSource`` does.

    members: classes of the run's N Gaussians. names: of the classes.
    """

    needs_run: ClassVar[bool] = True
    guesses: ClassVar[bool] = True

    members: Membership
    names: Mapping[int, str]

    def make(self, scene: SourceScene, progress: Progress) -> MadeMasks:
        assert scene.geometry is not None
        geometry = cast(TrainedGeometry, scene.geometry)
        if (now := len(geometry.surfels())) != len(self.members):
            raise UserError(
                f"the scene on disk has {now} Gaussians, but the open one has {len(self.members)}: open it again."
            )
        ids = [class_id for class_id in self.members.present() if class_id != BACKGROUND]
        masks = torch.stack([self.members.of(class_id) for class_id in ids], dim=1)
        total, steps = sum(scene.photos[place].trained for place in scene.places), count(1)
        maps = _drawn(scene, geometry, ids, masks, lambda: progress(next(steps), total))
        return MadeMasks({BACKGROUND: "background", **{each: self.names[each] for each in ids}}, maps, [])


def _drawn(
    scene: SourceScene,
    geometry: TrainedGeometry,
    class_ids: Sequence[int],
    members: Tensor,
    one_done: Callable[[], None],
) -> Iterator[np.ndarray | None]:
    """Yield the labels [H, W] uint16 of the objects in each photo, or None for a photo that is not for training.

    members: [N, objects] bool. A pixel gets the object that gives more than ``DRAWN`` of its light. Objects may share
    Gaussians, so several may do; then the object of fewest Gaussians wins, such as a vase over the table it stands on.
    """
    order = members.sum(dim=0).cpu().argsort(stable=True)
    ids, members = np.array(class_ids, np.uint16)[order.numpy()], members[:, order.to(members.device)]
    inputs = geometry_inputs(geometry.surfels())
    features = members.to(inputs.means)
    view_of = {place: index for index, place in enumerate(scene.places)}
    for place, photo in enumerate(scene.photos):
        if place not in view_of or not photo.trained:
            yield None
            continue
        camera = geometry.cameras[view_of[place]]
        with torch.no_grad():
            light = draw_features(geometry.rasterizer, inputs, features, camera, geometry.settings)
        shows = (light > DRAWN).cpu().numpy()
        labels = np.where(shows.any(axis=-1), ids[shows.argmax(axis=-1)], np.uint16(0))
        yield geometry.to_photo(labels, view_of[place])
        one_done()


Prompts = list[tuple[PromptedObject, Prompt]]


def _by_view(scene: SourceScene, objects: Sequence[PromptedObject], path: Path) -> dict[int, Prompts]:
    """Return the prompts of each prompted view, by its index in the geometry; raise ``UserError``."""
    prompts_of: dict[int, Prompts] = {}
    for one in objects:
        if not any(any(prompt.inside) for prompt in one.prompts.values()):
            raise UserError(f"{path} gives no point on {one.name}: give at least one in a view that shows it.")
        for stem, prompt in one.prompts.items():
            index = scene.prompted_view(stem, path)
            _check_inside(scene.photos[index], prompt, one.name)
            prompts_of.setdefault(scene.places.index(index), []).append((one, prompt))
    return prompts_of


def _check_inside(photo: Photo, prompt: Prompt, name: str) -> None:
    """Raise ``UserError`` for a point or box of a prompt outside the photo."""
    width, height = photo.width, photo.height
    outside = [f"point [{x:g}, {y:g}]" for x, y in prompt.points if not (0 <= x < width and 0 <= y < height)]
    if prompt.box is not None:
        left, top, right, bottom = prompt.box
        if left >= width or top >= height or right <= 0 or bottom <= 0:
            outside.append(f"box {list(prompt.box)}")
    if outside:
        raise UserError(
            f"the {outside[0]} of {name} in {photo.name} lies outside its image of {width}x{height} pixels: correct it."
        )


def view_marks(
    geometry: Geometry, index: int, scene: SourceScene, prompts: Prompts, whose: PromptedObject
) -> list[ViewMarks]:
    """Return the marks of an object in view ``index`` of the geometry, then those on other objects.

    Both lie in the view without lens distortion. prompts: of all objects in this view. Raises ``UserError`` for a pixel
    that is marked both on the object and beside it.
    """
    photo = scene.photos[scene.places[index]]
    width, height = photo.width, photo.height
    radius = max(1, round(MARK * float(np.hypot(width, height))))
    marked: dict[tuple[int, int], bool] = {}
    marks = []
    for others in (False, True):
        numbers = np.full((height, width), IGNORE, np.uint16)
        inside: list[bool] = []
        within = None
        for one, prompt in prompts:
            if (one is whose) == others:
                continue
            if prompt.box is not None and not others:
                left, top, right, bottom = prompt.box
                column, row = np.arange(width) + 0.5, np.arange(height)[:, None] + 0.5
                box = (column >= left) & (column <= right) & (row >= top) & (row <= bottom)
                within = torch.from_numpy(geometry.to_straight(box.astype(np.uint16), index) == 1)
            for (x, y), on in zip(prompt.points, prompt.inside, strict=True):
                if others and not on:
                    continue
                pixel, kind = (int(x), int(y)), on and not others
                if marked.setdefault(pixel, kind) != kind:
                    raise UserError(
                        f"the point [{x:g}, {y:g}] in {photo.name} is both on {whose.name} and beside it: remove one."
                    )
                _stamp(numbers, *pixel, radius, len(inside))
                inside.append(kind)
        if inside or within is not None:
            straight = torch.from_numpy(geometry.to_straight(numbers, index).astype(np.int32))
            marks.append(ViewMarks(photo.name, geometry.cameras[index], straight, tuple(inside), within, others))
    return marks


def _stamp(numbers: np.ndarray, x: int, y: int, radius: int, number: int) -> None:
    """Write the number to a pixel, and to the square around it where no earlier mark is."""
    part = numbers[max(y - radius, 0) : y + radius + 1, max(x - radius, 0) : x + radius + 1]
    part[part == IGNORE] = number
    numbers[y, x] = number
