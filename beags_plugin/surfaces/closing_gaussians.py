"""Flat Gaussians on the invented parts of an object's closed surface, which no photo shows."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from beags_plugin.core.lifting import pixels_of
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
_SIGMA = 0.75  # standard deviation over the distance between neighbours; three neighbours cover the gap between them
_INWARD = 0.5  # distance between neighbours over the distance from the rim
_FINEST = 1.5  # least distance between neighbours over that between the surface's vertices
_HALF = 1.2  # standard deviations from its centre at which an opaque Gaussian is half transparent
_CLEAR = 2.4  # standard deviations from its centre at which it no longer changes the object's outline
_ON_SCREEN = 0.71  # least standard deviation of a rendered Gaussian, pixels (2DGS's low-pass filter)
_LARGEST = 1 / 12  # largest distance between neighbours over the closed surface's longest side
_SAME_SIDE = 0.5  # least cosine between the normals of places on one side


@dataclass(frozen=True)
class Added:
    """The number of Gaussians that close an object, and the reason (doubt) why it could not be closed, or ""."""

    gaussians: int
    doubt: str = ""

    def __str__(self) -> str:
        if self.doubt:
            return f"nothing closed, as {self.doubt}"
        return f"{self.gaussians} more close what no photo shows" if self.gaussians else "nothing to close"


def with_closing(item: ExportItem, options: MeshOptions) -> tuple[ExportItem, Added]:
    """Return an item with Gaussians where no photo shows it, on the closed surface that the options give."""
    more, doubt = closing_gaussians(item, options)
    own = torch.zeros(len(item.surfels), dtype=torch.bool)
    if not len(more):
        return replace(item, invented=own), Added(0, doubt)
    ids = torch.cat([item.class_ids, item.class_ids[:1].expand(len(more))])
    invented = torch.cat([own, torch.ones(len(more), dtype=torch.bool)])
    both = joined(item.surfels.detach(), more)
    return replace(item, surfels=both, class_ids=ids, invented=invented), Added(len(more), doubt)


def closing_gaussians(item: ExportItem, options: MeshOptions) -> tuple[Surfels, str]:
    """Return the Gaussians that close an item where no photo shows it, and the reason why there are none, or ""."""
    none = item.surfels.detach()[:0]
    try:
        mesh = seen_surface(item, options)  # The surface of the splats is needed, not the one that photos align.
        if not len(mesh.faces):
            raise NothingToExport(f"no surface of {item.name!r} is seen in {options.min_views} training views")
        solid = closed_surface(item, mesh)
    except NothingToExport as error:
        return none, str(error).partition(":")[0]
    assert item.views is not None  # seen_surface raises without views.
    pixel = _pixel(item.views, solid.mesh.vertices)
    candidates = gaussians_on(solid, item.surfels, pixel)
    more = candidates[_within(candidates, item.surfels, item.views, pixel)]
    return more, "all Gaussians there would leave its outline" if len(candidates) and not len(more) else ""


def joined(*parts: Surfels) -> Surfels:
    """Return all Gaussians of the parts, in their order."""
    return Surfels(**{name: torch.cat([getattr(part, name) for part in parts]) for name in vars(parts[0])})


def _pixel(views: Viewpoints, points: np.ndarray) -> float:
    """Return the size of a pixel at the middle of points [P, 3], world units: the median over the views."""
    middle = torch.from_numpy((points.min(axis=0) + points.max(axis=0)) / 2)
    return float(np.median([float((each.center.double() - middle).norm()) / each.focal for each in views.cameras]))


@torch.no_grad()
def _within(more: Surfels, own: Surfels, views: Viewpoints, pixel: float) -> Tensor:
    """Return [M] bool, which Gaussians lie inside the outline of the object's own Gaussians in every view.

    Holes of an outline count as inside, because the Gaussians shall close them.
    """
    from scipy.ndimage import binary_fill_holes

    axes = rotation_from_quat(more.quats)[:, :, :2].mT.double()
    reach = _CLEAR * more.log_scales[:, :1].double().exp().clamp(min=_ON_SCREEN * pixel)[..., None]
    around = torch.cat([reach * axes, -reach * axes], dim=1)
    points = torch.cat([more.means[:, None].double(), more.means[:, None].double() + around], dim=1)
    inside = torch.ones(len(more), dtype=torch.bool)
    for camera in views.cameras:
        render = views.rasterizer.rasterize(surfel_inputs(own, camera), camera, views.settings, own.means.new_zeros(3))
        outline = torch.from_numpy(binary_fill_holes((render.alpha > 0.5).numpy()))
        framed, row, column, _ = pixels_of(points.reshape(-1, 3), camera.to(torch.float64))
        inside &= (outline[row, column] | ~framed).reshape(points.shape[:2]).all(dim=1)
    return inside


def gaussians_on(solid: Closed, like: Surfels, pixel: float) -> Surfels:
    """Return flat Gaussians on the invented parts of a closed surface, small at its rims and larger inside.

    Each has the colour of its place from all directions; higher bands, as many as ``like``, the object, has, are 0.
    pixel: size of a pixel of the photos at the surface; no Gaussian is made much smaller than that.
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
    """Return places [P, 3] over the invented parts, their unit normals and colours [P, 3], and distances [P].

    The places are face centres, taken in order, the farthest from the rim first; a centre is left out if it lies within
    the distance of one that was taken.
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
    spacing = float(np.sqrt(2.0 * np.median(areas)))  # distance of the faces' vertices
    rim = np.unique(faces[~invented[faces]])
    inward = KDTree(mesh.vertices[rim]).query(points)[0] if len(rim) else np.full(len(points), np.inf)
    longest = float(np.ptp(mesh.vertices, axis=0).max())
    finest = max(_FINEST * spacing, pixel)
    apart = np.clip(_INWARD * inward, finest, max(_LARGEST * longest, finest))
    # The Gaussians may reach the rim, but not cross it: the object's own Gaussians begin there.
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
    """Return unit quaternions [P, 4] wxyz of the smallest rotations that take z to unit normals [P, 3]."""
    x, y, z = normals.T
    quats = np.stack([1.0 + z, -y, x, np.zeros_like(z)], axis=1)  # 1 + cosine, and z x normal
    quats[z < -1.0 + 1e-9] = [0.0, 1.0, 0.0, 0.0]  # half a turn about a horizontal axis
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)
