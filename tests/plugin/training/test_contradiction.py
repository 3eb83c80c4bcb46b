"""Photos that contradict each other outside the masks: what counts, and how it is measured."""

from __future__ import annotations

import pytest
import torch

pytest.importorskip("nerfstudio")

from beags_plugin.plugin.training.contradiction import PixelSums, Residuals


@pytest.mark.parametrize(
    ("inside", "outside", "unexplained", "contradict"),
    [
        pytest.param(34.4, 19.7, 0.42, True, id="turntable"),
        pytest.param(30.2, 22.4, 0.14, False, id="bear before a wood, half of the base"),
        pytest.param(31.4, 23.1, 0.12, False, id="bear before a wood"),
        pytest.param(25.0, 24.0, 0.6, False, id="plain everywhere"),
    ],
)
def test_a_background_contradicts_itself_only_if_little_of_it_is_explained(inside, outside, unexplained, contradict):
    assert Residuals(inside, outside, unexplained).contradict == contradict


def test_sums_of_pixels_give_psnr_and_the_unexplained_share():
    generator = torch.Generator().manual_seed(1)
    photo = torch.rand((500, 3), generator=generator)
    rendered = photo + 0.05 * torch.randn((500, 3), generator=generator)
    sums = PixelSums()
    for part in (slice(0, 200), slice(200, 500)):
        sums.add(rendered[part], photo[part])
    error = (rendered - photo).double().square().mean()
    assert sums.psnr() == pytest.approx(float(-10 * error.log10()))
    assert sums.unexplained() == pytest.approx(float(error / photo.double().var(0, correction=0).mean()))
