"""The compiled occupancy loss against the torch version, and the same bits on any number of threads."""

from __future__ import annotations

import math

import pytest
import torch

from beags_plugin.core.rotations import rotation_from_quat
from beags_plugin.core.surfels import Surfels
from beags_plugin.losses.base import LossInputs
from beags_plugin.losses.occupancy import OccupancyLoss
from beags_plugin.occupancy.grid import VisibilityGrid
from beags_plugin.occupancy.sampling import sample_stream
from beags_plugin.ops import extension
from beags_plugin.ops.occupancy_loss import occupancy_loss

pytestmark = pytest.mark.skipif(extension.load() is None, reason="beags_plugin._native was not built")
FLOATS = ("means", "quats", "log_scales", "opacity_logits")
CLASSES = 4


def make_surfels(count: int, dtype=torch.float64, shift: float = 0.0) -> Surfels:
    """Make discs around the grid's cloud, of all sizes: within a voxel, over a few, and over many."""
    g = torch.Generator().manual_seed(5)
    values = (
        torch.rand(count, 3, generator=g, dtype=torch.float64) * 2.6 - 0.3 + shift,
        torch.randn(count, 4, generator=g, dtype=torch.float64),
        -3.2 + 1.2 * torch.randn(count, 2, generator=g, dtype=torch.float64),
        2.0 * torch.randn(count, generator=g, dtype=torch.float64),
        torch.zeros(count, 1, 3, dtype=torch.float64),
    )
    return Surfels.of(*(value.to(dtype).requires_grad_() for value in values))


def make_grid(stretch: float = 1.0, shift: float = 0.0) -> VisibilityGrid:
    """Three classes in slabs; class 0 has no voxels. ``stretch`` moves a few voxels far away."""
    g = torch.Generator().manual_seed(6)
    points = torch.rand(6000, 3, generator=g, dtype=torch.float64) * 2
    ids = (points[:, 1] * 1.5).int() + 1
    far = torch.tensor([[900.0, 3.0, -800.0], [-700.0, 800.0, 5.0]], dtype=torch.float64) * stretch
    points = torch.cat([points, far]) + shift
    return VisibilityGrid.from_points(
        [(points, torch.cat([ids, ids[:2]]))], 0.19, torch.full((3,), 0.01 + shift, dtype=torch.float64), CLASSES
    )


def ids_of(count: int) -> torch.Tensor:
    return torch.arange(count).remainder(CLASSES).int()


def inside_valid_voxels(means: torch.Tensor, axes: torch.Tensor, ids: torch.Tensor, grid: VisibilityGrid):
    """[N] bool: every voxel that a disc's box reaches is valid, and they are at most 9 along each axis."""
    half = axes.double().square().sum(-1).sqrt()
    low, high = (((means.double() + side * half - grid.origin) / grid.voxel_size).floor().long() for side in (-1, 1))
    inside = ((high - low) < 9).all(-1)
    for i in torch.nonzero(inside)[:, 0]:
        sides = [torch.arange(int(a), int(b) + 1) for a, b in zip(low[i], high[i], strict=True)]
        centers = grid.origin + (torch.cartesian_prod(*sides) + 0.5) * grid.voxel_size
        inside[i] = grid.valid(centers, ids[i].expand(len(centers))).all()
    return inside


def evaluate(surfels: Surfels, grid: VisibilityGrid, ids=None, **options) -> list[torch.Tensor]:
    """The value and the four gradients."""
    ids = ids_of(len(surfels)) if ids is None else ids
    inputs = LossInputs(
        step=11, seed=4, surfels=surfels, camera=None, render=None, image=None, class_ids=ids, grid=grid
    )
    value = OccupancyLoss(**options).value(inputs)
    return [value.detach(), *torch.autograd.grad(3 * value, [getattr(surfels, name) for name in FLOATS])]


@pytest.mark.parametrize("samples", [1, 7, 20])
@pytest.mark.parametrize("background", [True, False])
@pytest.mark.parametrize("stretch", [0.0, 1.0])
def test_it_is_the_torch_version(samples, background, stretch, without_extension):
    surfels, grid = make_surfels(403), make_grid(stretch)
    found = evaluate(surfels, grid, samples=samples, background=background)
    expected = without_extension(lambda: evaluate(surfels, grid, samples=samples, background=background))
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-12)
    assert expected[0] > 0.01
    active = sum(int((gradient.reshape(403, -1) != 0).any(1).sum()) for gradient in found[4:])
    assert 40 < active < 380


def test_float32_stays_within_its_band(without_extension):
    """Samples within rounding of a voxel's face may change sides; all others agree."""
    found = evaluate(make_surfels(2000, torch.float32), make_grid(), samples=20)
    expected = without_extension(lambda: evaluate(make_surfels(2000), make_grid(), samples=20))
    assert found[0].dtype == torch.float32
    assert float(found[0]) == pytest.approx(float(expected[0]), rel=1e-4)
    for name, a, b in zip(FLOATS, found[1:], expected[1:], strict=True):
        wrong = (a - b).abs() > 2e-4 * b.abs() + 1e-5 * b.abs().max()
        assert wrong.double().mean() < 2e-3, name


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_any_number_of_threads_gives_the_same_bits(dtype, for_threads):
    surfels, grid = make_surfels(9001, dtype), make_grid()
    runs = for_threads(lambda: evaluate(surfels, grid, samples=9))
    for other in runs[1:]:
        assert all(torch.equal(a, b) for a, b in zip(runs[0], other, strict=True))


def test_a_gaussian_does_not_depend_on_its_neighbours():
    """Bit for bit: gradients of the first 300 alone (which lie elsewhere in the kernel's batches) are the same."""
    surfels, grid = make_surfels(500, torch.float32), make_grid()
    whole = evaluate(surfels, grid, ids=ids_of(500))
    broken = Surfels.of(*(getattr(surfels, name).detach().clone().requires_grad_() for name in (*FLOATS, "sh")))
    with torch.no_grad():
        broken.means[::3] = math.nan
    part = evaluate(broken, grid, ids=ids_of(500))
    kept = torch.arange(500) % 3 != 0
    for a, b in zip(whole[1:], part[1:], strict=True):
        assert torch.equal(a[kept], b[kept])
        assert not b[~kept].any()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", FLOATS)
@pytest.mark.parametrize("poison", [math.nan, math.inf, -math.inf, 0.0, 1e4, -1e4, 1e30, -1e30])
def test_poison_does_not_spread(dtype, name, poison, without_extension):
    surfels, grid = make_surfels(50, dtype), make_grid()
    clean = evaluate(surfels, grid)
    with torch.no_grad():
        getattr(surfels, name)[7] = poison
    found = evaluate(surfels, grid)
    rest = torch.arange(50) != 7
    for a, b in zip(clean[1:], found[1:], strict=True):
        assert torch.equal(a[rest], b[rest])
    assert all(torch.isfinite(value).all() for value in found)
    expected = without_extension(lambda: evaluate(surfels, grid))
    torch.testing.assert_close(found[0], expected[0], rtol=1e-4, atol=0)


def test_whole_discs_inside_are_skipped_exactly():
    surfels, grid = make_surfels(3000, torch.float32), make_grid()
    parameters = [getattr(surfels, name).detach() for name in FLOATS]
    out = [torch.full_like(value, math.nan) for value in parameters]
    lookup, ids = grid.lookup(), ids_of(3000)
    compute = extension.load().occupancy_loss_f32
    value, active = compute(*parameters, ids, lookup.native, 1, 400, True, *out, 1)
    whole = [torch.full_like(value, math.nan) for value in parameters]
    value_of_all, sampled = compute(*parameters, ids, lookup.native, 1, 400, True, *whole, 1, skip=False)
    assert sampled == 3000 > active and value_of_all == pytest.approx(value, rel=1e-12)
    assert all(torch.equal(a, b) for a, b in zip(out, whole, strict=True))
    axes = 3.0 * parameters[2].exp()[:, None, :] * rotation_from_quat(parameters[1])[..., :2]
    inside = inside_valid_voxels(parameters[0], axes, ids, grid)
    assert 100 < int(inside.sum()) < 2000
    assert 3000 - active == pytest.approx(int(inside.sum()), abs=3)  # boxes in float32 and float64 round differently
    skipped_before = grid.disc_inside(parameters[0], axes[..., 0], axes[..., 1], ids)  # boxes of at most 4 voxels
    assert int((skipped_before & ~inside).sum()) <= 3 and int(inside.sum()) > int(skipped_before.sum()) + 20
    assert not any(value[inside].any() for value in out)  # none of 400 samples of theirs is outside
    assert all(torch.isfinite(value).all() for value in out)


def test_far_from_the_origin_the_skip_still_holds(without_extension):
    """Float32 at 1000 voxels from 0: what is skipped has no sample outside by the torch version's count."""
    surfels, grid = make_surfels(2000, torch.float32, shift=300.0), make_grid(0.0, shift=300.0)
    found = evaluate(surfels, grid, samples=100)
    expected = without_extension(lambda: evaluate(surfels, grid, samples=100))
    assert float(found[0]) == pytest.approx(float(expected[0]), rel=2e-3)


def test_nothing_to_do():
    surfels, grid = make_surfels(0), make_grid()
    value, *gradients = evaluate(surfels, grid)
    assert float(value) == 0.0
    assert [tuple(g.shape) for g in gradients] == [(0, 3), (0, 4), (0, 2), (0,)]
    empty = VisibilityGrid.from_points([], 1.0, torch.zeros(3), CLASSES)
    assert float(evaluate(make_surfels(20), empty)[0]) > 0.0


def test_no_samples_give_zero():
    surfels, lookup = make_surfels(20), make_grid().lookup()
    arguments = [getattr(surfels, name) for name in FLOATS]
    value = occupancy_loss(*arguments, ids_of(20), lookup, sample_stream(4, 11), 0)
    assert float(value) == 0.0
    assert not any(gradient.any() for gradient in torch.autograd.grad(value, arguments))


def test_classes_that_the_grid_does_not_know_have_no_voxels():
    surfels, grid = make_surfels(40), make_grid()
    unknown = evaluate(surfels, grid, ids=torch.full((40,), 77).int())
    none = evaluate(surfels, grid, ids=torch.zeros(40).int())
    assert all(torch.equal(a, b) for a, b in zip(unknown, none, strict=True))


def test_wrong_arguments_are_named():
    surfels, lookup = make_surfels(5), make_grid().lookup()
    arguments = [getattr(surfels, name) for name in FLOATS]
    for place, name in enumerate(FLOATS):
        spoilt = list(arguments)
        spoilt[place] = spoilt[place][:-1] if place else spoilt[place][:, :2]
        with pytest.raises(ValueError, match=name):
            occupancy_loss(*spoilt, ids_of(5), lookup, 0, 3)
    with pytest.raises(ValueError, match="class_ids"):
        occupancy_loss(*arguments, ids_of(5).long(), lookup, 0, 3)


def test_no_gradient_wanted_gives_the_same_value():
    surfels, grid = make_surfels(200), make_grid()
    arguments = [getattr(surfels, name) for name in FLOATS]
    value = occupancy_loss(*arguments, ids_of(200), grid.lookup(), sample_stream(4, 11), 20)
    bare = occupancy_loss(*(a.detach() for a in arguments), ids_of(200), grid.lookup(), sample_stream(4, 11), 20)
    assert torch.equal(value, bare) and value.requires_grad and not bare.requires_grad
