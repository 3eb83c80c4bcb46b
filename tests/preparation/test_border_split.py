"""The border split: halves render like the whole, the right Gaussians are chosen, classes follow."""

from __future__ import annotations

import pytest
import torch

from beags_plugin.core.cameras import Camera
from beags_plugin.core.splitting import split_in_two
from beags_plugin.core.surfels import Surfels
from beags_plugin.preparation import border_split
from beags_plugin.preparation.border_split import BorderSplitConfig, largest_sigma, split_at_borders
from beags_plugin.preparation.pipeline import PreparationConfig, prepare
from beags_plugin.preparation.refiner import AssignedScene
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.rasterizers.interface import RasterSettings
from beags_plugin.rasterizers.rendering import surfel_inputs
from beags_plugin.refiners.bea import BeaRefiner
from beags_plugin.refiners.none import NoRefiner
from beags_plugin.system.errors import UserError

SETTINGS = RasterSettings(near=0.1, far=100.0, geometry=False)
SIZE = 40
FOCAL = 40.0


def camera(z: float = 0.0) -> Camera:
    """Looks along z from (0, 0, z)."""
    K = torch.tensor([[FOCAL, 0.0, SIZE / 2], [0.0, FOCAL, SIZE / 2], [0.0, 0.0, 1.0]])
    viewmat = torch.eye(4)
    viewmat[2, 3] = -z
    return Camera(viewmat, K, SIZE, SIZE)


def discs(centers, scales, opacities) -> Surfels:
    """Discs that face the camera at depth 4, where a length of 0.1 covers a pixel; white."""
    count = len(centers)
    means = torch.tensor([[x, y, 4.0] for x, y in centers])
    sh = torch.full((count, 1, 3), 0.5 / 0.28209479177387814)
    quats = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(count, 1)
    return Surfels.of(means, quats, torch.tensor(scales).log(), torch.tensor(opacities).logit(), sh)


def drawn_alpha(surfels: Surfels) -> torch.Tensor:
    inputs = surfel_inputs(surfels, camera())
    return make_rasterizer("torch").rasterize(inputs, camera(), SETTINGS, torch.zeros(3)).alpha


@pytest.mark.parametrize(("opacity", "most"), [(0.1, 0.06), (0.5, 0.05), (0.9, 0.08), (0.99, 0.1)])
def test_two_halves_look_like_the_whole(opacity, most):
    whole = discs([(0.03, -0.02)], [(0.5, 0.3)], [opacity])
    halves = split_in_two(whole, torch.tensor([True])).surfels
    before, after = drawn_alpha(whole), drawn_alpha(halves)
    assert len(halves) == 2
    assert (after - before).square().mean().sqrt() < most * before.square().mean().sqrt()
    assert abs(float(after.sum() / before.sum()) - 1) < 0.04  # nearly as much light is stopped


def test_halves_lie_on_the_longer_axis_and_the_others_stay():
    surfels = discs([(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)], [(0.2, 0.1), (0.1, 0.4), (0.1, 0.1)], [0.5, 0.6, 0.7])
    edited = split_in_two(surfels, torch.tensor([True, True, False]))
    assert edited.source.tolist() == [2, 0, 1, 0, 1]
    assert edited.fresh.tolist() == [False, True, True, True, True]
    assert torch.equal(edited.surfels.means[0], surfels.means[2])
    torch.testing.assert_close(edited.surfels.means[1] - surfels.means[0], torch.tensor([0.1, 0.0, 0.0]))
    torch.testing.assert_close(edited.surfels.means[4] - surfels.means[1], torch.tensor([0.0, -0.2, 0.0]))
    assert torch.equal(edited.surfels.sh[1], surfels.sh[0])

    edited = split_in_two(surfels, torch.zeros(3, dtype=torch.bool))
    assert torch.equal(edited.surfels.log_scales, surfels.log_scales) and not edited.fresh.any()


def test_largest_sigma_is_that_of_the_nearest_view():
    surfels = discs([(0.0, 0.0)], [(0.2, 0.3)], [0.5])
    near, beyond = camera(z=2.0), camera(z=5.0)
    assert largest_sigma(surfels, [camera(), beyond]).item() == pytest.approx(0.3 * FOCAL / 4)
    assert largest_sigma(surfels, [camera(), near]).item() == pytest.approx(0.3 * FOCAL / 2)
    assert largest_sigma(surfels, [beyond]).item() == 0.0


@pytest.fixture(autouse=True)
def split_sooner(monkeypatch):
    monkeypatch.setattr(border_split, "MIN_SHARE", 0.1)


def two_halves() -> tuple[Surfels, torch.Tensor]:
    """A large disc across the border of two classes, one far from it, and a tiny one at it."""
    labels = torch.zeros(SIZE, SIZE, dtype=torch.int32)
    labels[:, SIZE // 2 :] = 1
    return discs([(0.1, 0.0), (-1.4, 0.0), (0.0, 1.5)], [(0.5, 0.2), (0.2, 0.2), (0.04, 0.04)], [0.9] * 3), labels


def test_only_large_ones_at_a_border_are_split_and_classes_follow():
    surfels, labels = two_halves()
    config = BorderSplitConfig(rounds=1)
    scene = split_at_borders(surfels, [camera()], [labels], make_rasterizer("torch"), SETTINGS, 2, config)
    assert scene.edited.source.tolist() == [1, 2, 0, 0]
    right, left = scene.edited.surfels.means[2, 0], scene.edited.surfels.means[3, 0]
    assert right > left
    assert scene.assignment.class_ids[[0, 2, 3]].tolist() == [0, 1, 0]  # the disc was wholly of class 1
    config = BorderSplitConfig(rounds=2)
    again = split_at_borders(surfels, [camera()], [labels], make_rasterizer("torch"), SETTINGS, 2, config)
    assert set(again.edited.source.tolist()) == {0, 1, 2}
    assert len(again.edited.surfels) > len(scene.edited.surfels)
    assert again.edited.fresh.tolist() == [source == 0 for source in again.edited.source.tolist()]


def test_prepare_splits_only_for_refiners_that_train():
    surfels, labels = two_halves()
    arguments = (surfels, [camera()], [labels], {0: "background", 1: "thing"}, make_rasterizer("torch"), SETTINGS)
    config, split = PreparationConfig(reprojection="none", k=5), BorderSplitConfig(rounds=1)
    kept = prepare(*arguments, NoRefiner(), config, split)
    assert kept.edited is None and len(kept.assignment.class_ids) == 3

    seen: list[AssignedScene] = []

    class Recorder(BeaRefiner):
        def build_grid(self, scene, k, progress=None):
            seen.append(scene)

    divided = prepare(*arguments, Recorder(), config, split)
    assert divided.edited is not None and len(divided.assignment.class_ids) == 3
    assert len(divided.edited.edited.surfels) == len(seen[0].surfels) == 4
    assert torch.equal(seen[0].class_ids, divided.edited.assignment.class_ids)
    assert any("became 4" in finding for finding in divided.summary) and "border split" in divided.seconds
    assert prepare(*arguments, Recorder(), config, BorderSplitConfig()).edited is None


def test_a_negative_number_of_rounds_is_refused():
    with pytest.raises(UserError, match="rounds = -1"):
        BorderSplitConfig(rounds=-1).check()
