"""Which Gaussians hold pixels of high error."""

from __future__ import annotations

import torch

from beags_plugin.assignment.high_errors import HighErrors, held_by_error
from beags_plugin.core.cameras import Camera
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.rasterizers.interface import RasterSettings, SurfelInputs

CAMERA = Camera(torch.eye(4), torch.tensor([[40.0, 0, 20], [0, 40.0, 15], [0, 0, 1]]), 40, 30)


def scene() -> SurfelInputs:
    """Left, right, and one that the opaque left one hides."""
    means = torch.tensor([[-0.5, 0.0, 2.0], [0.5, 0.0, 2.0], [-1.5, 0.0, 6.0]])
    return SurfelInputs(
        means,
        torch.tensor([[1.0, 0, 0, 0]]).repeat(3, 1),
        torch.tensor([[0.12], [0.12], [0.05]]).log().repeat(1, 2),
        torch.tensor([9.0, 9.0, 9.0]),
        torch.rand(3, 3, generator=torch.Generator().manual_seed(0)),
    )


def test_weights_are_parted_by_the_views_error():
    rasterizer, settings, inputs = make_rasterizer("torch"), RasterSettings(0.01, 100.0, geometry=False), scene()
    error = torch.full((30, 40), 0.01)
    error[:, 20:] = 0.3  # the right half
    held = held_by_error(rasterizer, inputs, CAMERA, settings, error)
    whole = rasterizer.class_contributions(inputs, CAMERA, settings, torch.zeros(30, 40, dtype=torch.int32), 1)
    assert torch.allclose(held.sum(dim=1), whole[:, 0], rtol=1e-5)
    assert held[0, 1] < 1e-3 * held[0, 0] and held[1, 0] < 1e-3 * held[1, 1]
    assert held[2].sum() < 0.05 * held[0].sum()  # hidden: it holds nothing
    nothing = held_by_error(rasterizer, inputs, CAMERA, settings, torch.zeros(30, 40))
    assert (nothing[:, 1] == 0).all()  # a perfect picture has no high error


def test_views_agree_where_half_of_the_weight_has_a_high_error():
    found = HighErrors(4)
    found.add(torch.tensor([[1.0, 1.0], [1.1, 1.0], [0.0, 0.0], [0.0, 3.0]]))
    found.add(torch.tensor([[0.0, 0.1], [1.0, 0.0], [0.0, 0.0], [5.0, 0.0]]))
    assert found.agreeing.tolist() == [2, 0, 0, 1]
