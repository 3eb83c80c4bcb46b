"""FlashSplat: the published thresholds, the L2 form, and four surfels drawn over three classes."""

from __future__ import annotations

import math

import pytest
import torch

from beags_baselines.flashsplat import GAMMA, members, threshold
from beags_plugin.core.cameras import Camera
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.rasterizers.interface import RasterSettings, SurfelInputs
from beags_plugin.system.errors import UserError

THRESHOLDS = {
    -1: 0.0,
    -0.9: 0.0875,
    -0.8: 0.157,
    -0.7: 0.215,
    -0.5: 0.311,
    -0.3: 0.391,
    0: 0.5,
    0.3: 0.609,
    0.4: 0.647,
    0.7: 0.785,
    0.75: 0.813,
    0.9: 0.913,
    1: 1.0,
}


def test_thresholds():
    assert {gamma: threshold(gamma) for gamma in THRESHOLDS} == pytest.approx(THRESHOLDS, abs=5e-4)
    assert (threshold(0), GAMMA) == (0.5, 0.4)


@pytest.mark.parametrize("gamma", [-1.01, 1.01, math.nan])
def test_gamma_beyond_one_is_refused(gamma):
    with pytest.raises(UserError, match="gamma is .*-1..1"):
        members(torch.ones(1), torch.ones(1), gamma)


@pytest.mark.parametrize("gamma", THRESHOLDS)
def test_the_share_is_the_normalised_pair_of_the_paper(gamma):
    generator = torch.Generator().manual_seed(0)
    pair = torch.rand(2, 20_000, generator=generator, dtype=torch.float64) ** 4 * 1e3  # many shares near 0 and 1
    pair[:, :3], pair[0, 3:6], pair[1, 6:9] = 0.0, 0.0, 0.0  # seen by nobody, by others alone, by the object alone
    pair[1, 9:12] = pair[0, 9:12]
    inside, rest = torch.nn.functional.normalize(pair, dim=0)
    assert torch.equal(members(pair[0], pair.sum(0), gamma), inside > rest + gamma)


def drawn_sums() -> torch.Tensor:
    """The sums [4, 3] of a small surfel in front of two wide ones, and of one behind the camera, over three stripes."""
    depth = torch.tensor([1.0, 2.0, 3.0, -1.0]).double()
    pixels = torch.tensor([[8.5, 10.0], [10.0, 10.0], [10.0, 10.0], [10.0, 10.0]]).double()
    deviation = torch.tensor([1.0, 200.0, 200.0, 200.0]).double()
    inputs = SurfelInputs(
        means=torch.cat([(pixels - 10.0) / 20.0 * depth[:, None], depth[:, None]], 1),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).double().repeat(4, 1),
        log_scales=(deviation / 20.0 * depth.abs()).log()[:, None].repeat(1, 2),
        opacity_logits=torch.tensor([0.9, 0.8, 0.8, 0.8]).double().logit(),
        colors=torch.zeros(4, 3).double(),
    )
    K = torch.tensor([[20.0, 0.0, 10.0], [0.0, 20.0, 10.0], [0.0, 0.0, 1.0]]).double()
    camera, settings = Camera(torch.eye(4).double(), K, 20, 20), RasterSettings(near=0.1, far=100.0, geometry=False)
    labels = torch.tensor([0] * 4 + [1] * 9 + [2] * 7, dtype=torch.int32).repeat(20, 1)
    return make_rasterizer("torch").class_contributions(inputs, camera, settings, labels, 3)


def test_drawn_surfels_join_by_share_and_not_by_argmax():
    sums = drawn_sums()
    totals = sums.sum(1)
    shares = (sums / totals[:, None])[:3]
    expected = torch.tensor([[0.0, 1.0, 0.0], [0.203, 0.442, 0.355], [0.203, 0.442, 0.355]]).double()
    torch.testing.assert_close(shares, expected, atol=6e-4, rtol=0)
    assert totals[1] / totals[2] == pytest.approx(5.0, rel=1e-2) and totals[3] == 0
    found = {
        gamma: [members(sums[:, c], totals, gamma).nonzero()[:, 0].tolist() for c in (1, 2)]
        for gamma in (0.0, 0.4, -0.3, -0.5)
    }
    assert found == {0.0: [[0], []], 0.4: [[0], []], -0.3: [[0, 1, 2, 3], [3]], -0.5: [[0, 1, 2, 3], [1, 2, 3]]}
