"""A known length in a scene, given by two clicks; it sets the size of exported files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.export.pose_options import check_length, scale_by_text
from beags_plugin.plugin.viewer.picking import camera_along
from beags_plugin.plugin.viewer.pointing import along
from beags_plugin.plugin.viewer.viewing import Viewing
from beags_plugin.rasterizers.rendering import geometry_inputs, surface_depth
from beags_plugin.surfaces.frames import Frame
from beags_plugin.system.errors import UserError

_APART = 4.0  # Pixels of the page; nearer points are the same one, clicked twice.


@dataclass(frozen=True)
class Place:
    """A place under a click.

    point: [3] float64, nerfstudio's world. pixel: size of the page's pixels there, world units.
    """

    point: Tensor
    pixel: float


@torch.no_grad()
def place_under(viewing: Viewing, position: Sequence[float], page: Camera) -> Place:
    """Return the place under a click, at the median depth, as ``--scale-by`` does for pixels of a photo.

    position, page: see ``click_mark``. Raises ``UserError`` if nothing solid is there.
    """
    direction, model = along(position, page), viewing.model
    view = camera_along(page.center.tolist(), direction.tolist(), focal=float(page.K[1, 1]))
    with viewing.held_soon():
        surfels = viewing.visible().surfels
        render = model.rasterizer.rasterize(
            geometry_inputs(surfels), view.to(surfels.means.device), model.settings(), surfels.means.new_zeros(3)
        )
        depth = float(surface_depth(render, "median")[0, 0])
    if not depth > 0:
        raise UserError("nothing solid is shown there: click on the scene.")
    return Place(page.center.double() + depth * direction / direction.norm(), depth / float(page.K[1, 1]))


@dataclass(frozen=True)
class Measure:
    """At most two places, and the text of the length between them; no method changes the measure itself."""

    places: tuple[Place, ...] = ()
    length: str = ""

    def clicked(self, place: Place) -> Measure:
        """Add a place; a third one begins anew. Raises ``UserError`` for the same place twice."""
        if len(self.places) != 1:
            return replace(self, places=(place,))
        (first,) = self.places
        if float((place.point - first.point).norm()) < _APART * max(place.pixel, first.pixel):
            raise UserError("that is A again: click on the other point, or come nearer.")
        return replace(self, places=(first, place))

    def scale_by(self, world: Frame) -> str:
        """Return the text of ``--scale-by``; empty if nothing is measured.

        world: frame of the input poses. Raises ``UserError`` for an incomplete measure.
        """
        typed = bool(self.length.strip())
        if not self.places and not typed:
            return ""
        if typed:
            check_length(self.length)
        undo = "or press Without a size there."
        if len(self.places) < 2:
            missing = "B is" if self.places else "two points are"
            raise UserError(f"{missing} missing for the size: click in the tab Size, {undo}")
        if not typed:
            raise UserError(f"the length from A to B is missing: type it in the tab Size, such as 12 cm, {undo}")
        first, second = (world.points(place.point[None])[0].tolist() for place in self.places)
        return scale_by_text(first, second, self.length)
