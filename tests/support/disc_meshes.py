"""Discs of surfels on the faces of meshes."""

from __future__ import annotations

import numpy as np
import torch

from beags_plugin.core.surfels import Surfels
from beags_plugin.surfaces.fusion import Mesh


def discs_on(mesh: Mesh) -> Surfels:
    """A small opaque disc on every face."""
    corners = mesh.vertices[mesh.faces]
    normals = torch.from_numpy(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])).float()
    normals = torch.nn.functional.normalize(normals, dim=1)
    half = normals + torch.tensor([0.0, 0.0, 1.0])  # half a turn about the middle between z and the normal
    half[half.norm(dim=1) < 1e-3] = torch.tensor([1.0, 0.0, 0.0])
    count = len(corners)
    colors = torch.from_numpy(mesh.colors[mesh.faces].mean(axis=1))
    sh = torch.zeros(count, 4, 3)
    sh[:, 0] = (colors - 0.5) / 0.2821
    return Surfels.of(
        torch.from_numpy(corners.mean(axis=1)).float(),
        torch.cat([torch.zeros(count, 1), half], dim=1),
        torch.full((count, 2), float(np.log(0.02))),
        torch.full((count,), 6.0),
        sh,
    )
