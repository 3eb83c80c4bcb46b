"""Which bands views can tell apart: ranks known by hand, least squares done otherwise, and the stage on a scene."""

from __future__ import annotations

import math

import pytest
import torch

from beags_plugin.assignment.assignment import Assignment
from beags_plugin.core.cameras import Camera
from beags_plugin.core.sh import sh_basis
from beags_plugin.core.sh_resolution import gram_matrices, seen_coefficients, seen_degree, seen_shares, with_degree
from beags_plugin.core.surfels import Surfels
from beags_plugin.preparation.fewer_bands import changes_of_fewer_bands, without_unneeded_bands
from beags_plugin.preparation.pipeline import PreparationConfig, prepare
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.rasterizers.interface import RasterSettings
from beags_plugin.refiners.bea import BeaRefiner
from beags_plugin.refiners.none import NoRefiner
from beags_plugin.system.errors import UserError

SETTINGS = RasterSettings(0.1, 100.0)


def camera_at(center: torch.Tensor, size: int = 24) -> Camera:
    """Looks from ``center`` [3] to the origin."""
    forward = -center / center.norm()
    aside = torch.tensor([0.0, 0.0, 1.0]) if forward[2].abs() < 0.9 else torch.tensor([1.0, 0.0, 0.0])
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, aside), dim=0)
    viewmat = torch.eye(4)
    viewmat[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward])
    viewmat[:3, 3] = -viewmat[:3, :3] @ center
    return Camera(viewmat, torch.tensor([[24.0, 0, size / 2], [0, 24.0, size / 2], [0, 0, 1]]), size, size)


def ring(count: int, height: float = 1.0) -> list[Camera]:
    """All at one height: a circle of directions, as a turntable gives."""
    turns = [2 * math.pi * index / count for index in range(count)]
    return [camera_at(torch.tensor([3 * math.cos(turn), 3 * math.sin(turn), height])) for turn in turns]


def sphere(count: int) -> list[Camera]:
    points = torch.randn(count, 3, generator=torch.Generator().manual_seed(0))
    return [camera_at(3 * point / point.norm()) for point in points]


def scene(degree: int = 3, count: int = 6) -> Surfels:
    g = torch.Generator().manual_seed(1)
    means = 0.2 * torch.randn(count, 3, generator=g)
    sh = 0.1 * torch.randn(count, (degree + 1) ** 2, 3, generator=g)
    return Surfels.of(
        means, torch.randn(count, 4, generator=g), torch.full((count, 2), -1.5), torch.full((count,), 2.0), sh
    )


ORIGIN = torch.zeros(1, 3)


@pytest.mark.parametrize(
    ("cameras", "coefficients", "degree"),
    [
        (sphere(60), 16, 3),
        (ring(24), 7, 0),  # on a circle: a constant, cos and sin of once, twice and three times the angle
        (ring(1), 1, 0),
        (ring(3), 3, 0),
        (sphere(4), 4, 1),
        ([camera_at(torch.tensor([3.0, 0.0, 0.0]))] * 5, 1, 0),
        ([], 0, -1),
    ],
)
def test_ranks_that_are_known(cameras, coefficients, degree):
    gram = gram_matrices(ORIGIN, cameras, 3)
    assert seen_coefficients(gram, 1e-3).tolist() == [coefficients]
    assert seen_degree(gram, 3, 1e-3).tolist() == [degree]


def test_only_views_whose_image_holds_the_centre_count():
    cameras = ring(5)
    points = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 40.0], [2.9, 0.0, 1.0]])
    gram = gram_matrices(points, cameras, 2)
    directions = torch.stack([-camera.center / camera.center.norm() for camera in cameras]).double()
    basis = sh_basis(directions, 2)
    torch.testing.assert_close(gram[0], basis.T @ basis / 5)
    assert not gram[1].any()  # above all views
    assert bool(gram[2].any()) and seen_coefficients(gram, 1e-4)[2] < 5  # one camera is too near
    share, degrees = seen_shares(points, cameras, 2, 1e-3)
    assert share == pytest.approx((5 + 0 + int(seen_coefficients(gram, 1e-3)[2])) / 27)
    assert degrees.sum() == pytest.approx(1.0) and degrees[0] == pytest.approx(1 / 3)


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_fewer_bands_are_the_least_squares_fit(degree):
    surfels, cameras = scene(), sphere(20)
    fewer = with_degree(surfels, cameras, degree)
    assert fewer.sh_degree == degree and torch.equal(fewer.means, surfels.means)
    low = (degree + 1) ** 2
    for i in range(len(surfels)):
        toward = torch.stack([surfels.means[i] - camera.center for camera in cameras]).double()
        basis = sh_basis(torch.nn.functional.normalize(toward, dim=1), 3)
        wanted = torch.linalg.lstsq(basis[:, :low], basis @ surfels.sh[i].double()).solution
        torch.testing.assert_close(fewer.sh[i].double(), wanted, rtol=1e-4, atol=1e-5)


def test_what_no_view_tells_apart_is_left_out_for_nothing():
    """On a circle about the only Gaussian, 3 z^2 - 1 is a constant: band 2 goes into band 0."""
    surfels, cameras = scene(2, 1), ring(12)
    surfels.means.zero_()
    surfels.sh_rest[:, [0, 1, 2, 3, 4, 6, 7]] = 0.0
    changes = changes_of_fewer_bands(surfels, cameras, make_rasterizer("torch"), SETTINGS)
    assert [part.sh_degree for part, _ in changes] == [0, 1] and changes[0][1] < 1e-6
    assert float((changes[0][0].sh_dc - surfels.sh_dc).abs().max()) > 0.01
    nothing = with_degree(surfels, [], 0)
    assert torch.equal(nothing.sh_dc, surfels.sh_dc)


def test_the_fewest_bands_within_the_tolerance_are_kept():
    surfels, cameras = scene(), sphere(8)
    changes = [change for _, change in changes_of_fewer_bands(surfels, cameras, make_rasterizer("torch"), SETTINGS)]
    assert changes[0] > changes[1] > changes[2] > 0.0
    for tolerance, degree in [(1.0, 0), (changes[1], 1), (0.99 * changes[1], 2), (0.5 * changes[2], 3)]:
        kept, change = without_unneeded_bands(surfels, cameras, make_rasterizer("torch"), SETTINGS, tolerance)
        assert kept.sh_degree == degree and change <= tolerance and (change == 0.0) == (degree == 3)


def test_the_stage_leaves_out_bands_only_where_it_is_asked_and_the_refiner_trains():
    surfels, cameras = scene(), sphere(8)
    masks = [torch.ones(24, 24, dtype=torch.int32) for _ in cameras]
    arguments = (surfels, cameras, masks, {0: "background", 1: "one"}, make_rasterizer("torch"), SETTINGS)
    trimmed = prepare(*arguments, BeaRefiner(), PreparationConfig(k=5, trim_sh=1.0))
    assert trimmed.edited is not None and trimmed.edited.edited.surfels.sh_degree == 0
    assert isinstance(trimmed.edited.assignment, Assignment) and "degree 3 became 0" in " ".join(trimmed.findings)
    assert torch.equal(trimmed.edited.assignment.class_ids, trimmed.assignment.class_ids)
    assert prepare(*arguments, BeaRefiner(), PreparationConfig(k=5)).edited is None
    assert prepare(*arguments, BeaRefiner(), PreparationConfig(k=5, trim_sh=1e-9)).edited is None
    assert prepare(*arguments, NoRefiner(), PreparationConfig(k=5, trim_sh=1.0)).edited is None
    with pytest.raises(UserError, match="trim_sh is -1"):
        PreparationConfig(trim_sh=-1.0).check()
