"""The spherical harmonics against what defines them, and against the values that splat files rely on."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from beags_plugin.core.sh import num_sh_bases, sh_basis, sh_colors

both = pytest.mark.usefixtures("ops")  # run with the torch versions and with the compiled ops


def sphere(rings: int = 8, spokes: int = 16):
    """Directions and weights that integrate polynomials up to degree 15 over the sphere exactly."""
    z, ring_weights = np.polynomial.legendre.leggauss(rings)
    angle = 2 * math.pi * (np.arange(spokes) + 0.3) / spokes
    z, angle = (grid.reshape(-1) for grid in np.meshgrid(z, angle, indexing="ij"))
    radius = np.sqrt(1 - z * z)
    directions = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=-1)
    return torch.from_numpy(directions), torch.from_numpy(np.repeat(ring_weights, spokes) * 2 * math.pi / spokes)


@pytest.mark.parametrize("degree", range(4))
def test_basis_is_orthonormal_over_the_sphere(degree):
    directions, weights = sphere()
    basis = sh_basis(directions, degree)
    assert basis.shape == (len(directions), num_sh_bases(degree)) == (len(directions), (degree + 1) ** 2)
    gram = basis.T @ (weights[:, None] * basis)
    torch.testing.assert_close(gram, torch.eye(len(gram), dtype=torch.float64), rtol=0, atol=1e-12)


def test_order_and_signs_are_those_of_splat_files():
    """One direction in general position; each function written out as in the published files' convention."""
    x, y, z = 2 / 7, 3 / 7, 6 / 7
    expected = [
        0.28209479177387814,
        -0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x,
        1.0925484305920792 * x * y, -1.0925484305920792 * y * z, 0.31539156525252005 * (2 * z * z - x * x - y * y),
        -1.0925484305920792 * x * z, 0.5462742152960396 * (x * x - y * y),
        -0.5900435899266435 * y * (3 * x * x - y * y), 2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4 * z * z - x * x - y * y),
        0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y),
        -0.4570457994644658 * x * (4 * z * z - x * x - y * y),
        1.445305721320277 * z * (x * x - y * y), -0.5900435899266435 * x * (x * x - 3 * y * y),
    ]  # fmt: skip
    basis = sh_basis(torch.tensor([[x, y, z]], dtype=torch.float64), 3)[0]
    torch.testing.assert_close(basis, torch.tensor(expected, dtype=torch.float64), rtol=1e-12, atol=1e-14)


@both
def test_colour_looks_from_the_camera_to_the_surfel_and_is_clamped():
    sh = torch.zeros(2, 4, 3, dtype=torch.float64)
    sh[:, 2] = torch.tensor([1.0, 0.5, -2.0])  # the function of z
    center = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    means = center + torch.tensor([[0.0, 0.0, 5.0], [0.0, 0.0, -5.0]], dtype=torch.float64)
    ahead = 0.4886025119029199 * torch.tensor([1.0, 0.5, -2.0], dtype=torch.float64)
    torch.testing.assert_close(
        sh_colors(sh[:, 0], sh[:, 1:], means, center, 1), torch.stack([0.5 + ahead, 0.5 - ahead]).clamp_min(0.0)
    )
    torch.testing.assert_close(
        sh_colors(sh[:, 0], sh[:, 1:], means, center, 0), torch.full((2, 3), 0.5, dtype=torch.float64)
    )


def test_another_degree_is_refused():
    with pytest.raises(ValueError, match="0..3"):
        sh_basis(torch.ones(1, 3), 4)
