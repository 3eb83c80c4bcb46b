"""Votes and grids made by the CUDA kernels, on a GPU or in the emulation, bit for bit those of the CPU."""

from __future__ import annotations

import math

import pytest
import test_voxel_lookup
import torch
from cuda_backends import cuda_device
from voted_views import METHODS, larger_scene, same

from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.labels.label_maps import LabelMaps
from beags_plugin.masks.reprojection import reproject_pairwise
from beags_plugin.masks.voxel_reprojection import reproject_voxel
from beags_plugin.occupancy.grid import VisibilityGrid
from beags_plugin.ops import cuda_extension, extension, voxel_bricks, voxel_tally
from beags_plugin.system.errors import UserError

pytestmark = pytest.mark.skipif(extension.load() is None, reason="beags_plugin._native was not built")
device = pytest.fixture(params=["cuda", "cuda emulated"])(cuda_device)


@pytest.fixture
def cpu_version(monkeypatch):
    """A function that computes something without CUDA."""

    def compute(call):
        with monkeypatch.context() as patch:
            patch.setattr(cuda_extension, "module_for", lambda *tensors: None)
            return call()

    return compute


def reprojected(method, scene, device, **options):
    """Masks and confidences, on the CPU; nothing of the inputs changes."""
    depths, cameras, labels, num_classes = scene
    there = [None if mask is None else mask.to(device) for mask in labels]
    there = LabelMaps(there) if isinstance(labels, LabelMaps) else there
    found = list(method([depth.to(device) for depth in depths], cameras, there, num_classes, **options))
    assert all(mask.labels.device.type == device.type for mask in found)
    return [type(mask)(mask.labels.cpu(), mask.confidence.cpu()) for mask in found]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("method", METHODS)
def test_both_reprojections_are_the_cpus(method, dtype, device, cpu_version):
    scene = larger_scene(dtype)
    found = reprojected(method, scene, device)
    assert same(found, cpu_version(lambda: list(method(*scene))))
    changed = [(new.labels != old).double().mean() for new, old in zip(found, scene[2], strict=True) if old is not None]
    assert min(changed) > 0.001
    assert len(torch.cat([mask.confidence.view(-1) for mask in found]).unique()) >= 4


@pytest.mark.parametrize("tau", [0.005, math.inf])
def test_pairwise_votes_with_maps_of_bytes_are_the_cpus(tau, device, cpu_version):
    depths, cameras, labels, num_classes = larger_scene()
    scene = (depths, cameras, LabelMaps(labels), num_classes)
    assert {None if m is None else m.dtype for m in map(scene[2].narrow, range(5))} == {None, torch.uint8}
    found = reprojected(reproject_pairwise, scene, device, tau=tau)
    assert same(found, cpu_version(lambda: list(reproject_pairwise(*scene, tau=tau))))


def test_voxels_of_many_classes_are_the_cpus(device, cpu_version, monkeypatch):
    """Labels at random, far apart and many to a voxel, in tables that grow with every view."""
    monkeypatch.setattr(voxel_tally, "_LEAST", 4)
    depths, cameras, labels, _ = larger_scene()
    g = torch.Generator().manual_seed(4)
    ids = torch.tensor([0, 3, 40, 700, 65_534, IGNORE])
    labels = [None if m is None else ids[torch.randint(0, 6, m.shape, generator=g)].int() for m in labels]
    scene = (depths, cameras, labels, IGNORE)
    found = reprojected(reproject_voxel, scene, device)
    assert same(found, cpu_version(lambda: list(reproject_voxel(*scene))))
    assert len({float(share) for mask in found for share in mask.confidence.view(-1)}) > 30


@pytest.mark.parametrize("method", METHODS)
def test_nobody_votes(method, device, cpu_version):
    depths, cameras, labels, num_classes = larger_scene()
    scene = ([torch.zeros_like(depth) for depth in depths], cameras, labels, num_classes)
    assert same(reprojected(method, scene, device), cpu_version(lambda: list(method(*scene))))


def clouds(dtype, device):
    g = torch.Generator().manual_seed(6)
    for count in (3000, 0, 5000):
        points = 4 * torch.rand(count, 3, generator=g, dtype=torch.float64) ** 2
        ids = (points[:, 0] + 0.2 * torch.rand(count, generator=g, dtype=torch.float64) > 1.0).to(torch.uint8) * 7
        yield points.to(dtype).to(device), ids.to(device)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_grids_of_points_are_the_cpus(dtype, device, cpu_version, monkeypatch):
    monkeypatch.setattr(voxel_tally, "_LEAST", 4)
    origin = torch.tensor([0.1, -0.2, 0.03], dtype=torch.float64)
    expected = cpu_version(lambda: VisibilityGrid.from_points(clouds(dtype, torch.device("cpu")), 0.11, origin, 8))
    found = VisibilityGrid.from_points(clouds(dtype, device), 0.11, origin.to(device), 8)
    assert found.keys.device.type == device.type
    assert torch.equal(found.keys.cpu(), expected.keys) and torch.equal(found.classes.cpu(), expected.classes)
    assert len(found.keys) > 2000 and len(found.classes.unique()) == 2
    everything = torch.cat([points for points, _ in clouds(torch.float64, torch.device("cpu"))])
    assert len(found.keys) < len(((everything - origin) / 0.11).floor().unique(dim=0))  # some voxels were shared


@pytest.mark.parametrize("bad", [1e9, math.nan, math.inf])
def test_points_without_a_voxel_are_reported(bad, device):
    points = torch.zeros(5, 3, device=device)
    points[3, 1] = bad
    origin, ids = torch.zeros(3, dtype=torch.float64, device=device), torch.zeros(5, dtype=torch.int32, device=device)
    with pytest.raises(UserError, match="voxels of size 0.5 apart or are not finite"):
        VisibilityGrid.from_points([(points, ids)], 0.5, origin, 2)


@pytest.mark.parametrize("spread", [0.0, 4.0, 300.0, 5000.0, 100_000.0])
def test_tables_made_there_are_the_cpus(spread, device):
    """Arrays equal, cell by cell; of hash tables, the bricks of each class."""
    grid = (
        test_voxel_lookup.make_grid(spread)
        if spread
        else VisibilityGrid(
            1.0,
            torch.zeros(3, dtype=torch.float64),
            2,
            torch.zeros(0, dtype=torch.int64),
            torch.zeros(0, dtype=torch.int32),
        )
    )
    lookup = grid.lookup()
    keys, ranks, count = lookup._occupied
    module = cuda_extension.module_for(torch.zeros(1, device=device))
    made = voxel_bricks.tables(module, keys.to(device), ranks.to(device), count)
    assert made is not None
    for (classes, _, _, *expected), (dense, slots, ranges) in zip(lookup.native.tables(), made[1], strict=True):
        assert classes == count
        array, expected_slots, expected_ranges = (
            torch.frombuffer(bytearray(part), dtype=torch.int64) if part else torch.zeros(0, dtype=torch.int64)
            for part in expected
        )
        if dense is not None:
            assert torch.equal(dense.cpu(), array)
            continue
        assert torch.equal(ranges.cpu().view(-1)[0::3], expected_ranges[0::3])
        for first, mask, _ in ranges.tolist():
            both = [table.cpu().view(-1, 2)[first : first + mask + 1].tolist() for table in (slots, expected_slots)]
            assert sorted(both[0]) == sorted(both[1])
    hashed = [dense is None for dense, *_ in made[1]]
    assert all(hashed) if spread > 1000 else not any(hashed) or spread == 300


def test_voxels_too_far_apart_to_be_numbered_come_from_the_cpu(device, monkeypatch):
    monkeypatch.setattr(voxel_bricks, "_MOST_CELLS", 10)
    grid = test_voxel_lookup.make_grid(4.0)
    points, ids = test_voxel_lookup.queries(grid, torch.float64)
    there = VisibilityGrid.from_state_dict({name: value.to(device) for name, value in grid.state_dict().items()})
    expected = grid.lookup().native
    out = torch.empty(len(points), dtype=torch.bool)
    expected.valid_f64(points, grid.lookup().ranks(ids), out, 1)
    assert torch.equal(there.valid(points.to(device), ids.to(device)).cpu(), out)
