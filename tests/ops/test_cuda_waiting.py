"""A training step on a GPU's tensors that have no data: no number of theirs is fetched, no devices are mixed."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils._python_dispatch import TorchDispatchMode

from beags_plugin.core.cameras import Camera
from beags_plugin.core.densification import GradientStatistics
from beags_plugin.core.surfels import Surfels
from beags_plugin.labels.class_ranks import ClassRanks
from beags_plugin.losses import silhouette
from beags_plugin.losses.base import LossInputs
from beags_plugin.losses.boundary import BoundaryLoss
from beags_plugin.losses.class_members import ClassMembers
from beags_plugin.losses.distortion import DistortionLoss
from beags_plugin.losses.normal import NormalConsistencyLoss
from beags_plugin.losses.occupancy import OccupancyLoss
from beags_plugin.losses.photometric import PhotometricLoss
from beags_plugin.losses.silhouette import SilhouetteLoss
from beags_plugin.ops import cuda_extension
from beags_plugin.ops.voxel_lookup import VoxelLookup
from beags_plugin.rasterizers.interface import RasterOutputs

N, HEIGHT, WIDTH = 50, 40, 60
ON_HOST = Camera(torch.eye(4), torch.eye(3), WIDTH, HEIGHT)  # a camera whose matrices have data
LOSSES = [
    PhotometricLoss(),
    NormalConsistencyLoss(),
    BoundaryLoss(),
    OccupancyLoss(samples=20),
    DistortionLoss(weight=1.0),
    SilhouetteLoss(objects=2),
    SilhouetteLoss(objects=1, seen=9),
]


class Fetches(TorchDispatchMode):
    """Notes what copies from a GPU to the CPU, and what copies the other way while the host waits.

    (Numbers asked of a tensor without data raise by themselves.)
    """

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        out = function(*args, **(kwargs or {}))
        devices = {value.device.type for value in args if isinstance(value, torch.Tensor)}
        if isinstance(out, torch.Tensor):
            there = out.device.type == "cuda" and "cpu" in devices and "copy" in str(function)
            waits = there and not (kwargs or {}).get("non_blocking", False)
            if waits or (out.device.type == "cpu" and "cuda" in devices):
                self.found.append(str(function))
        return out


@pytest.fixture
def gpu(monkeypatch):
    """Tensors on a GPU that is not there, and kernels that do nothing."""
    module = SimpleNamespace(OCCUPANCY_THREADS=128, PHOTOMETRIC_TILE=16, NORMAL_THREADS=256)
    on_gpu = lambda *tensors: module if tensors[0].device.type == "cuda" else None  # noqa: E731
    monkeypatch.setattr(cuda_extension, "module_for", on_gpu)
    monkeypatch.setattr(cuda_extension, "call", lambda *_: None)
    # Numbers that the host draws at random would have no data either.
    monkeypatch.setattr(silhouette, "_chosen", lambda count, wanted, *_: list(range(count))[:wanted])
    with FakeTensorMode(), Fetches() as fetches:
        yield fetches


def rand(*shape: int, **options) -> torch.Tensor:
    return torch.rand(*shape, device="cuda", **options)


def outputs(alpha: torch.Tensor | None = None) -> RasterOutputs:
    image = (HEIGHT, WIDTH)
    return RasterOutputs(
        color=rand(*image, 3, requires_grad=True), alpha=rand(*image) if alpha is None else alpha,
        depth=rand(*image, requires_grad=True), median_depth=rand(*image),
        normal=rand(*image, 3, requires_grad=True), distortion=rand(*image, requires_grad=True),
        boundary=rand(*image, requires_grad=True), visible=rand(N) > 0.5, num_nonfinite=0,
    )  # fmt: skip


def inputs(surfels: Surfels, **known) -> LossInputs:
    """known: what the host does."""
    image = (HEIGHT, WIDTH)
    camera = Camera(rand(4, 4), rand(3, 3), WIDTH, HEIGHT)
    camera.__dict__["_host"] = ON_HOST
    ranks = ClassRanks.__new__(ClassRanks)
    ranks._table = torch.zeros(9, dtype=torch.int32, device="cuda")
    lookup = VoxelLookup.__new__(VoxelLookup)
    lookup._ranks, lookup._native, lookup.voxels = ranks, None, lambda *_: None
    return LossInputs(
        step=20_000, seed=1, surfels=surfels, camera=camera, render=outputs(),
        image=rand(*image, 3), labels=torch.zeros(image, dtype=torch.int32, device="cuda"),
        class_ids=torch.zeros(N, dtype=torch.int32, device="cuda"),
        grid=SimpleNamespace(lookup=lambda: lookup, count=lookup.count),
        draw=lambda drawn, camera: outputs(drawn.means.mean() + rand(*image)), **known,
    )  # fmt: skip


def members_of_two() -> ClassMembers:
    """Return class members as an earlier step has left them."""
    members = ClassMembers(torch.zeros(N, dtype=torch.int32, device="cuda"))
    members._order, members._spans = torch.arange(N, device="cuda"), {0: (0, 20), 1: (20, 40), 3: (40, 50)}
    return members


def parameters() -> list[torch.Tensor]:
    shapes = ((N, 3), (N, 4), (N, 2), (N,), (N, 3), (N, 15, 3))
    return [rand(*shape).requires_grad_() for shape in shapes]


@pytest.mark.parametrize("loss", LOSSES, ids=lambda loss: type(loss).__name__)
def test_a_loss_waits_for_nothing(loss, gpu):
    """The forward; autograd's own way back needs a device, and asks for no numbers."""
    value = loss.weighted(inputs(Surfels(*parameters()), members=members_of_two(), present=[1, 3]))
    assert value.device.type == "cuda" and value.shape == () and value.requires_grad
    assert gpu.found == []


def test_growth_and_adam_wait_for_nothing(gpu):
    leaves = parameters()
    surfels = Surfels(*leaves)
    adam = torch.optim.Adam(leaves, lr=0.1, fused=True)
    statistics = GradientStatistics(N, "cuda")
    adam.zero_grad()
    for leaf in leaves:
        leaf.grad = torch.ones_like(leaf)
    statistics.add(surfels.means.grad.norm(dim=-1), rand(N) > 0.5)
    assert statistics.mean().device.type == "cuda"
    adam.step()
    assert gpu.found == []


@pytest.mark.parametrize("missing", ["members", "present"])
def test_a_loss_without_what_the_host_knows_waits(gpu, missing):
    known = {"members": members_of_two(), "present": [1, 3]}
    with pytest.raises(Exception, match="item|local_scalar|unique|bincount|nonzero"):
        SilhouetteLoss().weighted(inputs(Surfels(*parameters()), **{**known, missing: None}))


def test_what_fetches_is_noticed(gpu):
    with pytest.raises(Exception, match="item|local_scalar"):
        float(rand(3).sum())
    rand(3).cpu()
    assert len(gpu.found) == 1
