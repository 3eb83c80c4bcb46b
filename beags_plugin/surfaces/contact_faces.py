"""Gaussians that close objects where they touch, such as the lid of a box below another object.

No photo shows such a face, so the base has a hole there, which becomes visible when the neighbour is removed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.core.lifting import TAU, hides, pixels_of
from beags_plugin.core.membership import Membership
from beags_plugin.core.rotations import rotation_from_quat
from beags_plugin.core.select import select_class
from beags_plugin.core.surfels import Surfels
from beags_plugin.labels.class_ids import BACKGROUND, IGNORE
from beags_plugin.rasterizers.rendering import geometry_inputs, surface_depth
from beags_plugin.surfaces.closing_gaussians import closing_gaussians, joined
from beags_plugin.surfaces.item import ExportItem, Viewpoints
from beags_plugin.surfaces.mesh_options import MeshOptions

LEAST_VIEWS = 2  # least number of views in which another object hides the front of a place
_FACING = 0.1  # least cosine between a place's normal and the direction of a camera that faces its front


@dataclass(frozen=True)
class ContactFaces:
    """M Gaussians and their classes, class_ids [M] int32."""

    surfels: Surfels
    class_ids: Tensor


class Witnesses:
    """Numbers of views that face the front of each of M places, by what they show there; all [M] int64.

    hidden: another object before the place. open: the background before it, or anything behind it, by more than ``TAU``
    of the depth; or its own object there. Views with that before it, and pixels without a label, do not count.
    """

    def __init__(self, places: Surfels, class_ids: Tensor) -> None:
        """Begin with no view. places: M flat Gaussians, normals outwards; class_ids: [M] of their objects."""
        self._points = places.means.double()
        self._normals = rotation_from_quat(places.quats)[:, :, 2].double()
        self._class_ids = class_ids
        self.hidden, self.open = torch.zeros(2, len(places), dtype=torch.int64)

    def add(self, camera: Camera, labels: Tensor, depth: Tensor) -> None:
        """Add a view. labels: [H, W] class ids or IGNORE. depth: [H, W] of the scene's surface, 0 where it has none."""
        to_camera = torch.nn.functional.normalize(camera.center.double() - self._points, dim=1)
        inside, row, column, z = pixels_of(self._points, camera.to(torch.float64))
        faces = ((to_camera * self._normals).sum(dim=1) > _FACING) & inside
        label, surface = labels[row, column], depth[row, column].double()
        surface = torch.where(surface > 0, surface, torch.inf)
        own, other = label == self._class_ids, (label != self._class_ids) & (label != IGNORE)
        is_object = other & (label != BACKGROUND)
        self.hidden += faces & is_object & (surface < z)  # Objects touch: any distance counts.
        self.open += faces & own & ~hides(surface, z)
        self.open += faces & other & ((surface >= (1.0 + TAU) * z) | (~is_object & hides(surface, z)))

    def in_contact(self) -> Tensor:
        """Return [M] bool, which places are hidden by another object in more views than show them open."""
        return (self.hidden >= LEAST_VIEWS) & (self.hidden > self.open)


@torch.no_grad()
def contact_faces(
    surfels: Surfels,
    members: Membership,
    names: Mapping[int, str],
    views: Viewpoints,
    labels: Sequence[Tensor | None],
    options: MeshOptions,
    progress: Callable[[int, int], None],
) -> ContactFaces:
    """Return the Gaussians that close the objects of a scene where other objects hid them.

    surfels: N Gaussians, on the CPU. names: the classes' names by id. views: training views; labels: [H, W] each, None
    where a view has none. options: those of the surfaces that find the holes. progress: receives (done, total) objects
    and views.
    """
    faces: list[ContactFaces] = []
    in_scene = replace(views, scene=surfels)  # A box alone would show its inside through its open lid.
    objects = [class_id for class_id in names if class_id != BACKGROUND and bool(members.of(class_id).any())]
    if len(objects) < 2:  # A single object touches no other.
        objects = []
    total = len(objects) + len(views.cameras)
    for done, class_id in enumerate(objects):
        progress(done, total)
        part = select_class(surfels, members, class_id)[0]
        ids = torch.full((len(part),), class_id, dtype=torch.int32)
        more = closing_gaussians(ExportItem(names[class_id], part, ids, in_scene), options)[0]
        faces.append(ContactFaces(more, torch.full((len(more),), class_id, dtype=torch.int32)))
    candidates = ContactFaces(
        joined(surfels[:0], *(each.surfels for each in faces)),
        torch.cat([torch.zeros(0, dtype=torch.int32), *(each.class_ids for each in faces)]),
    )
    witnesses = Witnesses(candidates.surfels, candidates.class_ids)
    inputs, settings = geometry_inputs(surfels), replace(views.settings, geometry=True, distortion=False)
    for index, (camera, of_view) in enumerate(zip(views.cameras, labels, strict=True)):
        progress(len(objects) + index, total)
        if len(candidates.surfels) and of_view is not None:
            render = views.rasterizer.rasterize(inputs, camera, settings, surfels.means.new_zeros(3))
            witnesses.add(camera, of_view.cpu(), surface_depth(render, "median"))
    progress(total, total)
    in_contact = witnesses.in_contact()
    return ContactFaces(candidates.surfels[in_contact], candidates.class_ids[in_contact])
