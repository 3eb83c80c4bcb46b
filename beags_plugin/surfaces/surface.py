"""Areas, normals and ray casting of meshes."""

from __future__ import annotations

from typing import Any

import numpy as np

from beags_plugin.core.cameras import Camera
from beags_plugin.surfaces.fusion import Mesh
from beags_plugin.system.open3d_kernels import open3d_kernels


def area_vectors(mesh: Mesh) -> np.ndarray:
    """Return the outward normals of faces, [F, 3], as long as their areas."""
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    return np.cross(b - a, c - a) / 2


def vertex_normals(mesh: Mesh) -> np.ndarray:
    """Return [V, 3] float64 unit normals, the faces' weighted by area; z for a vertex without faces."""
    normals = np.zeros_like(mesh.vertices)
    areas = area_vectors(mesh)
    for axis in range(3):
        for corner in range(3):
            normals[:, axis] += np.bincount(mesh.faces[:, corner], areas[:, axis], len(normals))
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.where(length > 0, normals / np.where(length > 0, length, 1.0), [0.0, 0.0, 1.0])


def surface_of(mesh: Mesh) -> Any:
    """Return Open3D's scene of a mesh, whose unit is the voxel and origin the mesh's first vertex (float32)."""
    open3d = open3d_kernels()

    scene, tensor = open3d.t.geometry.RaycastingScene(), open3d.core.Tensor
    scene.add_triangles(in_voxels(mesh, mesh.vertices), tensor(mesh.faces.astype(np.uint32)))
    return scene


def in_voxels(mesh: Mesh, points: np.ndarray) -> Any:
    """Return Open3D's tensor of points [P, 3] in the frame of ``surface_of``."""
    open3d = open3d_kernels()

    return open3d.core.Tensor(((points - mesh.vertices[0]) / mesh.voxel).astype(np.float32))


def corner_weights(uvs: np.ndarray) -> np.ndarray:
    """Return the weights [P, 3] float64 of a face's corners at Open3D's coordinates ``primitive_uvs`` [P, 2]."""
    u, v = uvs.astype(np.float64).T
    return np.stack([1.0 - u - v, u, v], axis=1)


def rays_through(mesh: Mesh, camera: Camera, xy: np.ndarray) -> tuple[Any, np.ndarray]:
    """Return Open3D's tensor of rays [P, 6] through pixel coordinates [P, 2], in the frame of ``surface_of``.

    Their parameter is the depth along the camera's z, in the mesh's unit. Returns also their directions [P, 3] per unit
    of depth.
    """
    open3d = open3d_kernels()

    K = camera.K.double().numpy()
    ways = np.concatenate([(xy - K[:2, 2]) / K[[0, 1], [0, 1]], np.ones((len(xy), 1))], axis=1)
    ways = ways @ camera.rotation.double().numpy()
    start = in_voxels(mesh, camera.center.double().numpy()[None]).numpy()
    rays = np.concatenate([np.broadcast_to(start, ways.shape), ways / mesh.voxel], axis=1)
    return open3d.core.Tensor(rays.astype(np.float32)), ways
