"""A ball as a mesh, with colours of vertices and with a texture."""

from __future__ import annotations

import numpy as np

from beags_plugin.surfaces.atlas import unwrapped
from beags_plugin.surfaces.fusion import Mesh
from beags_plugin.surfaces.texture import Texture


def a_ball() -> Mesh:
    """Return a ball away from the origin, each vertex with a random colour."""
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.3)
    places = np.array(ball.vertices) + [1.0, 2.0, 3.0]
    colors = np.random.default_rng(0).random((len(places), 3)).astype(np.float32)
    return Mesh(places, np.array(ball.faces), colors, 0.01)


def texture_of(mesh: Mesh) -> Texture:
    """Return a texture of random pixels that covers the mesh."""
    image = np.random.default_rng(0).integers(0, 256, (128, 128, 3), dtype=np.uint8)
    return Texture(unwrapped(mesh, 128), image, 1.0, np.ones((1, 3)))
