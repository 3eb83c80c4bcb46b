"""Areas, normals and ray casting of meshes."""

from __future__ import annotations

from typing import Any

import numpy as np

from beags_plugin.export.fusion import Mesh


def area_vectors(mesh: Mesh) -> np.ndarray:
    """Return [F, 3] the outward normals of faces, as long as their areas."""
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    return np.cross(b - a, c - a) / 2


def vertex_normals(mesh: Mesh) -> np.ndarray:
    """Return [V, 3] float64 unit normals, of faces by their areas; z where a vertex has none."""
    normals = np.zeros_like(mesh.vertices)
    areas = area_vectors(mesh)
    for axis in range(3):
        for corner in range(3):
            normals[:, axis] += np.bincount(mesh.faces[:, corner], areas[:, axis], len(normals))
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.where(length > 0, normals / np.where(length > 0, length, 1.0), [0.0, 0.0, 1.0])


def surface_of(mesh: Mesh) -> Any:
    """Return Open3D's scene of a mesh, whose unit is the voxel and origin the mesh's first vertex (float32)."""
    import open3d

    scene, tensor = open3d.t.geometry.RaycastingScene(), open3d.core.Tensor
    scene.add_triangles(in_voxels(mesh, mesh.vertices), tensor(mesh.faces.astype(np.uint32)))
    return scene


def in_voxels(mesh: Mesh, points: np.ndarray) -> Any:
    """Return Open3D's tensor of points [P, 3] in the frame of ``surface_of``."""
    import open3d

    return open3d.core.Tensor(((points - mesh.vertices[0]) / mesh.voxel).astype(np.float32))
