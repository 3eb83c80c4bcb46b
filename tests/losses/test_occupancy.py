"""The occupancy loss (E9) against a slow version that autograd differentiates."""

from __future__ import annotations

import math
import subprocess
import sys

import pytest
import torch
from places import ROOT

import beags_plugin.losses.occupancy as occupancy
from beags_plugin.core.rotations import rotation_from_quat
from beags_plugin.core.surfels import Surfels
from beags_plugin.losses.base import LossInputs
from beags_plugin.losses.occupancy import OccupancyLoss
from beags_plugin.occupancy.grid import VisibilityGrid
from beags_plugin.occupancy.sampling import disc_points, sample_words

both = pytest.mark.usefixtures("ops")  # run with the torch versions and with the compiled ops

COUNT = 30
FLOATS = ("means", "quats", "log_scales", "opacity_logits")


def _surfels(dtype=torch.float64, count: int = COUNT, factor: float = 1.0) -> Surfels:
    g = torch.Generator().manual_seed(0)
    values = (
        factor * (torch.rand(count, 3, generator=g, dtype=torch.float64) * 2.4 - 0.2),
        torch.randn(count, 4, generator=g, dtype=torch.float64),
        -2.3 + 0.6 * torch.randn(count, 2, generator=g, dtype=torch.float64) + math.log(factor),
        torch.randn(count, generator=g, dtype=torch.float64),
        torch.zeros(count, 1, 3, dtype=torch.float64),
    )
    return Surfels.of(*(value.to(dtype).requires_grad_() for value in values))


def _grid(factor: float = 1.0) -> VisibilityGrid:
    g = torch.Generator().manual_seed(1)
    points = torch.rand(4000, 3, generator=g, dtype=torch.float64) * torch.tensor([1.0, 2.0, 2.0])
    ids = (points[:, 1] > 1.0).int() + 1
    origin = torch.tensor([0.03, -0.01, 0.02], dtype=torch.float64)
    return VisibilityGrid.from_points([(factor * points, ids)], 0.21 * factor, factor * origin, 3)


def _ids(count: int = COUNT) -> torch.Tensor:
    return torch.arange(count).remainder(3).int()


def _inputs(surfels, grid=None, step: int = 7, seed: int = 3, ids=None) -> LossInputs:
    return LossInputs(
        step=step, seed=seed, surfels=surfels, camera=None, render=None, image=None,
        class_ids=_ids(len(surfels)) if ids is None else ids, grid=grid or _grid(),
    )  # fmt: skip


def _slow(surfels: Surfels, grid: VisibilityGrid, ids, points: torch.Tensor, invalid: torch.Tensor) -> torch.Tensor:
    """E9 as it is written; ``points`` [Z, N, 3] and ``invalid`` [Z, N] are constants."""
    R = rotation_from_quat(surfels.quats)
    offset = points - surfels.means
    u = (offset * R[..., 0]).sum(-1) / surfels.log_scales[:, 0].exp()
    v = (offset * R[..., 1]).sum(-1) / surfels.log_scales[:, 1].exp()
    terms = torch.sigmoid(surfels.opacity_logits) * torch.exp(-(u**2 + v**2) / 2) * invalid
    return terms.sum() / (points.shape[0] * points.shape[1])


@torch.no_grad()
def _constants(surfels: Surfels, grid, ids, samples: int, step: int = 7, seed: int = 3):
    """The sample points, and where D_occ (by counting) is 0."""
    words = sample_words(seed, step, torch.arange(len(surfels)), torch.arange(samples))
    u, v = disc_points(words, surfels.means.dtype)
    R, s = rotation_from_quat(surfels.quats), surfels.log_scales.exp()
    points = surfels.means + (u * s[:, 0])[..., None] * R[..., 0] + (v * s[:, 1])[..., None] * R[..., 1]
    count = grid.count(points.view(-1, 3), ids.repeat(samples)).view(samples, -1)
    return points, (count == 0).to(points)


def _gradients(value: torch.Tensor, surfels: Surfels) -> list[torch.Tensor]:
    return list(torch.autograd.grad(value, [getattr(surfels, name) for name in FLOATS]))


@both
@pytest.mark.parametrize("samples", [1, 20])
def test_value_and_gradients_equal_autograd(samples):
    surfels, grid = _surfels(), _grid()
    value = OccupancyLoss(samples=samples).value(_inputs(surfels, grid))
    slow = _slow(surfels, grid, _ids(), *_constants(surfels, grid, _ids(), samples))
    assert float(slow) > 0.01
    assert float(value) == pytest.approx(float(slow), rel=1e-12)
    for name, a, b in zip(FLOATS, _gradients(3 * value, surfels), _gradients(3 * slow, surfels), strict=True):
        assert b.abs().max() > 0
        assert torch.allclose(a, b, rtol=1e-9, atol=1e-12), name


@both
def test_skipped_gaussians_change_nothing():
    """All inside: no loss, no gradient. Some inside: the others' points stay the same."""
    surfels, grid = _surfels(), _grid()
    with torch.no_grad():
        surfels.log_scales.sub_(1.5)
    active = occupancy._outside(*(getattr(surfels, name).detach() for name in FLOATS), _ids(), grid)
    assert 0 < len(active) < COUNT
    gradients = _gradients(OccupancyLoss().value(_inputs(surfels, grid)), surfels)
    skipped = torch.ones(COUNT, dtype=torch.bool)
    skipped[active] = False
    assert all(not gradient[skipped].any() for gradient in gradients)
    _, invalid = _constants(surfels, grid, _ids(), 500)
    assert not invalid[:, skipped].any()  # Counted: none of 500 points of a skipped disc is outside.


@both
def test_everything_inside_gives_zero_with_gradients():
    surfels = Surfels.of(**{name: getattr(_surfels(), name) for name in (*FLOATS, "sh")})
    with torch.no_grad():
        surfels.means.copy_(torch.tensor([0.5, 0.5, 1.0]).expand(COUNT, 3))
        surfels.log_scales.fill_(-5.0)
    value = OccupancyLoss().value(_inputs(surfels, ids=torch.ones(COUNT).int()))
    assert float(value) == 0.0
    assert all(not gradient.any() for gradient in _gradients(value, surfels))
    nothing = surfels[:0]
    assert float(OccupancyLoss().value(_inputs(nothing, ids=torch.zeros(0).int()))) == 0.0


@both
def test_a_class_without_voxels_is_penalised_everywhere():
    surfels = _surfels()
    ids = torch.zeros(COUNT, dtype=torch.int32)  # no point of class 0 was lifted
    value = OccupancyLoss(samples=4000).value(_inputs(surfels, ids=ids))
    # mean of exp(-r^2 / 2) over the disc of radius 3
    expected = torch.sigmoid(surfels.opacity_logits).mean() * 2 / 9 * (1 - math.exp(-4.5))
    assert float(value) == pytest.approx(float(expected), rel=0.02)


def test_results_do_not_depend_on_chunks(monkeypatch):
    surfels = _surfels(torch.float32)
    results = []
    for chunk in (1 << 16, 64, 7):
        monkeypatch.setattr(occupancy, "_CHUNK_POINTS", chunk)
        value = OccupancyLoss().value(_inputs(surfels))
        results.append([value.detach(), *_gradients(value, surfels)])
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


@both
def test_results_do_not_depend_on_threads():
    count = 70_001  # enough for torch to split
    surfels, results, threads = _surfels(torch.float32, count), [], torch.get_num_threads()
    try:
        for number in (1, 2, 3):
            torch.set_num_threads(number)
            value = OccupancyLoss(samples=2).value(_inputs(surfels))
            results.append([value.detach(), *_gradients(value, surfels)])
    finally:
        torch.set_num_threads(threads)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


@both
def test_many_samples_take_no_more_memory():
    """The largest tensor that one evaluation makes is the same for Z = 20 and Z = 1000."""
    from torch.utils._python_dispatch import TorchDispatchMode

    class Largest(TorchDispatchMode):
        size = 0

        def __torch_dispatch__(self, func, types, args=(), kwargs=None):
            out = func(*args, **(kwargs or {}))
            for value in out if isinstance(out, (tuple, list)) else [out]:
                if isinstance(value, torch.Tensor):
                    self.size = max(self.size, value.numel())
            return out

    surfels, grid, sizes, values = _surfels(torch.float32, 3000), _grid(), [], []
    for samples in (100, 1000):
        with Largest() as mode:
            value = OccupancyLoss(samples=samples).value(_inputs(surfels, grid))
        sizes.append(mode.size)
        values.append(float(value))
    assert sizes[1] <= sizes[0] and values[1] == pytest.approx(values[0], rel=0.02)


@both
def test_broken_surfels_count_as_nothing():
    for name, value in [("means", math.nan), ("means", math.inf), ("quats", 0.0), ("log_scales", math.inf),
                        ("log_scales", -math.inf), ("opacity_logits", math.nan)]:  # fmt: skip
        surfels = _surfels()
        with torch.no_grad():
            getattr(surfels, name)[4] = value
        loss = OccupancyLoss().value(_inputs(surfels))
        whole = OccupancyLoss().value(_inputs(_surfels()))
        assert math.isfinite(float(loss)) and float(loss) <= float(whole)
        if name == "quats":  # its own gradient may be undefined, the others' not
            continue
        assert all(torch.isfinite(gradient).all() for gradient in _gradients(loss, surfels)), name


def test_it_needs_a_grid():
    inputs = _inputs(_surfels())
    with pytest.raises(ValueError, match="grid"):
        OccupancyLoss().value(LossInputs(**{**inputs.__dict__, "grid": None}))


def test_importing_the_packages_stays_light():
    code = (
        "import sys, beags_plugin.masks, beags_plugin.losses, beags_plugin.occupancy, beags_plugin.assignment; "
        "sys.exit(', '.join(m for m in ('scipy', 'cv2', 'open3d', 'nerfstudio', 'PIL') if m in sys.modules) or 0)"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=False)
    assert result.returncode == 0, result.stderr


@both
def test_the_background_has_a_share_of_the_weight():
    surfels, ids = _surfels(), _ids()
    objects = surfels[ids != 0]
    value = OccupancyLoss(background=0.0, samples=4000).value(_inputs(surfels))
    alone = OccupancyLoss(samples=4000).value(_inputs(objects, ids=ids[ids != 0]))
    assert float(value) == pytest.approx(float(alone) * len(objects) / COUNT, rel=0.05)  # other points, same mean
    assert all(not gradient[ids == 0].any() for gradient in _gradients(value, surfels))
    whole = OccupancyLoss().value(_inputs(surfels))
    part, without = (OccupancyLoss(background=share).value(_inputs(surfels)) for share in (0.25, 0.0))
    assert float(whole) > 1.1 * float(without)
    assert float(part) == pytest.approx(0.25 * float(whole) + 0.75 * float(without))
    of_ids = torch.where(ids == 0, 0.25, 1.0)
    for own, all_of_it in zip(_gradients(part, surfels), _gradients(whole, surfels), strict=True):
        torch.testing.assert_close(own, all_of_it * of_ids.view(-1, *[1] * (own.dim() - 1)))


@both
def test_a_gaussian_that_no_ray_sees_learns_position_scale_rotation_and_opacity():
    """Behind an opaque wall the image gives no gradient at all; the occupancy loss reaches every kind of parameter."""
    from beags_plugin.core.cameras import Camera
    from beags_plugin.rasterizers import make_rasterizer
    from beags_plugin.rasterizers.interface import RasterSettings
    from beags_plugin.rasterizers.rendering import surfel_inputs

    wall = 20  # opaque layers, each large, before the camera's whole view
    means = torch.cat([torch.tensor([[0.0, 0.0, 2.0]]).repeat(wall, 1), torch.tensor([[0.05, 0.02, 4.0]])])
    means[:wall, 2] += torch.linspace(0, 0.5, wall)
    log_scales = torch.full((wall + 1, 2), 2.0)
    log_scales[-1] = torch.tensor([-1.5, -2.0])
    quats = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(wall + 1, 1)
    quats[-1] = torch.tensor([0.9, 0.2, 0.3, 0.1])
    logits = torch.full((wall + 1,), 8.0)
    sh = torch.zeros(wall + 1, 1, 3)
    leaves = [value.requires_grad_() for value in (means, quats, log_scales, logits)]
    surfels = Surfels.of(*leaves, sh)
    camera = Camera(torch.eye(4), torch.tensor([[20.0, 0, 8], [0, 20, 8], [0, 0, 1]]), 16, 16)
    render = make_rasterizer("torch").rasterize(
        surfel_inputs(surfels, camera), camera, RasterSettings(0.1, 10.0), torch.ones(3)
    )
    (render.color.sum() + render.depth.sum()).backward()
    assert all(not leaf.grad[-1].any() for leaf in leaves)

    # valid space covers a part of the hidden disc only, so that its pull has a direction
    points = torch.tensor([[0.05 - 0.1, 0.02, 4.0]])
    grid = VisibilityGrid.from_points([(points, torch.tensor([1]))], 0.1, torch.zeros(3), 2)
    class_ids = torch.ones(wall + 1, dtype=torch.int32)
    for leaf in leaves:
        leaf.grad = None
    inputs = LossInputs(0, 0, surfels, camera, render, torch.zeros(16, 16, 3), class_ids=class_ids, grid=grid)
    OccupancyLoss(samples=50).value(inputs).backward()
    assert all(leaf.grad[-1].any() and torch.isfinite(leaf.grad).all() for leaf in leaves)
