"""Gaussians of what no photo shows of an object: flat ones on the parts of its closed surface that are invented."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from beags_plugin.core.lifting import project
from beags_plugin.core.rotations import rotation_from_quat
from beags_plugin.core.sh import SH_C0
from beags_plugin.core.surfels import Surfels
from beags_plugin.rasterizers.rendering import surfel_inputs
from beags_plugin.surfaces.closing import Closed
from beags_plugin.surfaces.item import ExportItem, NothingToExport, Viewpoints
from beags_plugin.surfaces.mesh_options import MeshOptions
from beags_plugin.surfaces.meshing import closed_surface, seen_surface
from beags_plugin.surfaces.surface import area_vectors

_OPACITY = 0.99
_SIGMA = 0.75  # standard deviation over the distance between neighbours: three of them hide what is between
_INWARD = 0.5  # distance between neighbours over that from the rim
_FINEST = 1.5  # distance between neighbours over that between the surface's corners
_HALF = 1.2  # standard deviations from its middle at which an opaque Gaussian is half transparent
_CLEAR = 2.4  # and at which it adds so little to the object's own edge that its outline stays
_ON_SCREEN = 0.71  # pixels: the standard deviation that a Gaussian is drawn with at least (2DGS's low-pass filter)
_LARGEST = 1 / 12  # distance between neighbours over the closed surface's longest side
_SAME_SIDE = 0.5  # least cosine between the normals of places of one side


@dataclass(frozen=True)
class Added:
    """gaussians: their number. doubt: why nothing could be closed, or ""."""

    gaussians: int
    doubt: str = ""

    def __str__(self) -> str:
        """Return a phrase for users."""
        if self.doubt:
            return f"nothing closed, as {self.doubt}"
        return f"{self.gaussians} more close what no photo shows" if self.gaussians else "nothing to close"


def with_closing(item: ExportItem, options: MeshOptions) -> tuple[ExportItem, Added]:
    """Return an item with Gaussians where no photo shows it, by the closed surface that the options lead to."""
    more, doubt = closing_gaussians(item, options)
    own = torch.zeros(len(item.surfels), dtype=torch.bool)
    if not len(more):
        return replace(item, invented=own), Added(0, doubt)
    ids = torch.cat([item.class_ids, item.class_ids[:1].expand(len(more))])
    invented = torch.cat([own, torch.ones(len(more), dtype=torch.bool)])
    both = joined(item.surfels.detach(), more)
    return replace(item, surfels=both, class_ids=ids, invented=invented), Added(len(more), doubt)


def closing_gaussians(item: ExportItem, options: MeshOptions) -> tuple[Surfels, str]:
    """Return the Gaussians that close an item where no photo shows it, and why there are none, or ""."""
    none = item.surfels.detach()[:0]
    try:
        mesh = seen_surface(item, options)  # where the splats are; photos would place it elsewhere
        if not len(mesh.faces):
            raise NothingToExport(f"no surface of {item.name!r} is seen in {options.min_views} training views")
        solid = closed_surface(item, mesh)
    except NothingToExport as error:
        return none, str(error).partition(":")[0]
    assert item.views is not None  # the surface was seen from there
    pixel = _pixel(item.views, solid.mesh.vertices)
    wanted = closing_surfels(solid, item.surfels, pixel)
    more = wanted[_within(wanted, item.surfels, item.views, pixel)]
    return more, "all Gaussians there would leave its outline" if len(wanted) and not len(more) else ""


def joined(*parts: Surfels) -> Surfels:
    """Return all Gaussians of the parts, in their order."""
    return Surfels(**{name: torch.cat([getattr(part, name) for part in parts]) for name in vars(parts[0])})


def _pixel(views: Viewpoints, points: np.ndarray) -> float:
    """Return how large a pixel is at a thing of points [P, 3], the median over the views."""
    middle = torch.from_numpy((points.min(axis=0) + points.max(axis=0)) / 2)
    return float(np.median([float((each.center.double() - middle).norm()) / each.focal for each in views.cameras]))


@torch.no_grad()
def _within(more: Surfels, own: Surfels, views: Viewpoints, pixel: float) -> Tensor:
    """Return [M] bool, which Gaussians lie inside the outline of an object's own ones in every view.

    Holes of an outline count as inside: they are what is to be closed.
    """
    from scipy.ndimage import binary_fill_holes

    axes = rotation_from_quat(more.quats)[:, :, :2].mT.double()
    reach = _CLEAR * more.log_scales[:, :1].double().exp().clamp(min=_ON_SCREEN * pixel)[..., None]
    around = torch.cat([reach * axes, -reach * axes], dim=1)
    points = torch.cat([more.means[:, None].double(), more.means[:, None].double() + around], dim=1)
    inside = torch.ones(len(more), dtype=torch.bool)
    for camera in views.cameras:
        drawn = views.rasterizer.rasterize(surfel_inputs(own, camera), camera, views.settings, own.means.new_zeros(3))
        outline = torch.from_numpy(binary_fill_holes((drawn.alpha > 0.5).numpy()))
        xy, z = project(points.reshape(-1, 3), camera.to(torch.float64))
        limit = torch.tensor([camera.width, camera.height])
        framed = (z > 0) & ((xy >= 0) & (xy < limit)).all(dim=1)
        column, row = xy.nan_to_num().floor().long().clamp(min=0).minimum(limit - 1).T
        inside &= (outline[row, column] | ~framed).reshape(points.shape[:2]).all(dim=1)
    return inside


def closing_surfels(solid: Closed, like: Surfels, pixel: float) -> Surfels:
    """Return flat Gaussians on the invented parts of a closed surface, small at its rims and larger inside.

    Each has the colour of its place from every side: degree 0, though they have the bands of ``like``, the object's.
    pixel: size of a pixel of the photos at the surface; no Gaussian is drawn much smaller than that.
    """
    points, normals, colors, apart = _spread(solid, pixel)
    count, means = len(points), like.means
    quats = _quats_to(normals)
    logs = np.log(_SIGMA * apart)[:, None].repeat(2, axis=1)

    def tensor(values: np.ndarray) -> Tensor:
        return torch.from_numpy(values).to(means.dtype)

    return Surfels(
        tensor(points),
        tensor(quats),
        tensor(logs),
        tensor(np.full(count, np.log(_OPACITY / (1.0 - _OPACITY)))),
        tensor((colors - 0.5) / SH_C0),
        torch.zeros(count, like.sh_rest.shape[1], 3, dtype=means.dtype),
    )


def _spread(solid: Closed, pixel: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return places [P, 3] over the invented parts, unit normals and colours [P, 3] there, and distances [P].

    Every place of these parts but those at the rim is as near to one of them as the distance there says. They are taken
    in order, the farthest from the rim first; a place is left out if one that was taken is near enough.
    """
    from scipy.spatial import KDTree

    mesh, invented = solid.mesh, solid.invented
    faces = mesh.faces[invented[mesh.faces].any(axis=1)]
    nothing = np.zeros((0, 3))
    if not len(faces):
        return nothing, nothing, nothing, np.zeros(0)
    points, colors = (each[faces].mean(axis=1, dtype=np.float64) for each in (mesh.vertices, mesh.colors))
    normals = area_vectors(replace(mesh, faces=faces))
    areas = np.linalg.norm(normals, axis=1)
    normals /= np.maximum(areas, 1e-300)[:, None]
    spacing = float(np.sqrt(2.0 * np.median(areas)))  # of the faces' corners
    rim = np.unique(faces[~invented[faces]])
    inward = KDTree(mesh.vertices[rim]).query(points)[0] if len(rim) else np.full(len(points), np.inf)
    longest = float(np.ptp(mesh.vertices, axis=0).max())
    finest = max(_FINEST * spacing, pixel)
    apart = np.clip(_INWARD * inward, finest, max(_LARGEST * longest, finest))
    # up to the rim, but not beyond it: the object's own Gaussians begin there
    reach = _HALF * np.maximum(_SIGMA * apart, _ON_SCREEN * pixel)
    tree, open_ = KDTree(points), (areas > 0) & (inward > reach)
    taken = []
    for place in np.lexsort((*points.T, -np.round(inward / spacing, 3))):
        if open_[place]:
            taken.append(place)
            near = np.array(tree.query_ball_point(points[place], apart[place]))
            open_[near[normals[near] @ normals[place] > _SAME_SIDE]] = False
    return points[taken], normals[taken], colors[taken], apart[taken]


def _quats_to(normals: np.ndarray) -> np.ndarray:
    """Return unit quaternions [P, 4] wxyz of turns that take z to unit normals [P, 3], by the shortest way."""
    x, y, z = normals.T
    quats = np.stack([1.0 + z, -y, x, np.zeros_like(z)], axis=1)  # 1 + cosine, and z x normal
    quats[z < -1.0 + 1e-9] = [0.0, 1.0, 0.0, 0.0]  # half a turn about any level axis
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)
