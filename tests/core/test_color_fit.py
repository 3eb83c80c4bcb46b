"""The best affine map of colours: against known maps and numpy's least squares, and where nothing determines it."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from beags_plugin.core.color_fit import affine_color_fit, apply_affine

IDENTITY = torch.cat([torch.eye(3), torch.zeros(3, 1)], dim=1).double()
KNOWN = torch.tensor([[0.7, 0.1, 0.0, 0.05], [0.0, 0.6, 0.05, 0.1], [-0.1, 0.0, 0.8, 0.2]], dtype=torch.float64)


def image(seed: int = 0, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    return torch.rand(24, 31, 3, dtype=dtype, generator=torch.Generator().manual_seed(seed))


def test_a_known_map_comes_back():
    rendered = image()
    assert torch.allclose(affine_color_fit(rendered, apply_affine(rendered, KNOWN)), KNOWN, atol=1e-10)
    fitted = affine_color_fit(rendered.float(), apply_affine(rendered, KNOWN).float())
    assert fitted.dtype == torch.float64 and torch.allclose(fitted, KNOWN, atol=1e-6)
    assert apply_affine(rendered.float(), fitted).dtype == torch.float32


def test_it_is_the_least_squares_solution():
    rendered, photo = image(1), image(2)
    design = np.concatenate([rendered.reshape(-1, 3).numpy(), np.ones((24 * 31, 1))], axis=1)
    expected, *_ = np.linalg.lstsq(design, photo.reshape(-1, 3).numpy(), rcond=None)
    assert np.allclose(affine_color_fit(rendered, photo).numpy(), expected.T, atol=1e-10)


def test_only_the_named_and_finite_pixels_count():
    rendered = image()
    photo, where = apply_affine(rendered, KNOWN), torch.zeros(24, 31, dtype=torch.bool)
    where[:10] = True
    photo[12:] = 0.5
    rendered[3, 4, 1], photo[5, 6, 2] = torch.nan, torch.inf
    assert torch.allclose(affine_color_fit(rendered, photo, where), KNOWN, atol=1e-10)
    assert not torch.allclose(affine_color_fit(rendered, photo), KNOWN, atol=1e-2)
    assert torch.equal(affine_color_fit(rendered, photo, where & False), IDENTITY)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_one_colour_moves_to_the_mean_without_another_change(dtype):
    """A single colour tells the offset alone: the matrix stays the identity, and rounding errors do not matter."""
    rendered = torch.tensor([0.1, 0.2, 0.3], dtype=dtype).expand(24, 31, 3)
    photo = image(3, dtype)
    fitted = affine_color_fit(rendered, photo)
    assert torch.allclose(fitted[:, :3], IDENTITY[:, :3], atol=1e-6)
    assert torch.allclose(apply_affine(rendered, fitted)[0, 0], photo.mean(dim=(0, 1)), atol=1e-6)


def test_greys_fit_and_what_greys_do_not_tell_stays():
    grey = image()[..., :1].expand(-1, -1, 3)
    fitted = affine_color_fit(grey, 0.5 * grey + 0.1)
    assert torch.allclose(apply_affine(grey, fitted), 0.5 * grey + 0.1, atol=1e-10)
    across = torch.tensor([1.0, -1.0, 0.0], dtype=torch.float64)  # a direction of colour that no grey has
    assert torch.allclose(fitted[:, :3] @ across, across, atol=1e-10)


def test_a_colour_that_a_channel_lacks_fits_too():
    rendered = image()
    rendered[..., 2] = 0.0
    photo = rendered.flip(-1)
    assert torch.allclose(apply_affine(rendered, affine_color_fit(rendered, photo)), photo, atol=1e-10)
