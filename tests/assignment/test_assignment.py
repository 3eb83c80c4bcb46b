"""Assignment (E6): sums over views, ties, Gaussians never seen; and the reference rasterizer's contributions."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from raster_scenes import CLASSES, make_scene

from beags_plugin.assignment.assignment import by_largest
from beags_plugin.assignment.contributions import contributions
from beags_plugin.core.surfels import Surfels
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.rasterizers import RASTERIZERS, make_rasterizer
from beags_plugin.rasterizers.interface import RasterSettings
from beags_plugin.rasterizers.rendering import geometry_inputs
from beags_plugin.system.errors import UserError

SETTINGS = RasterSettings(near=0.1, far=100.0)


class _Stub:
    """Returns the contributions in the camera's table."""

    def sparse_class_contributions(self, inputs, camera, settings, labels, num_classes):
        assert not settings.geometry and not settings.distortion
        assert inputs.means.requires_grad is False
        table = torch.tensor(camera.table, dtype=torch.float32)
        assert table.shape[1] == num_classes
        surfel, class_id = torch.nonzero(table, as_tuple=True)
        return surfel * num_classes + class_id, table[surfel, class_id]


def _surfels(count: int) -> Surfels:
    shapes = [(count, 4), (count, 2), (count,), (count, 1, 3)]
    return Surfels.of(torch.zeros(count, 3, requires_grad=True), *(torch.zeros(shape) for shape in shapes))


def test_sums_over_views_with_ties_to_the_lower_id():
    cameras = [
        SimpleNamespace(table=[[0, 3, 1], [0, 0, 0], [0, 2, 2], [1, 0, 0]]),
        SimpleNamespace(table=[[0, 0, 4], [0, 0, 0], [0, 1, 1], [0, 0, 3]]),
        SimpleNamespace(table=[[0, 0, 0]] * 4, height=2, width=2),
    ]
    mask, calls = torch.zeros(2, 2, dtype=torch.int32), []
    result = by_largest(
        contributions(
            _surfels(4), cameras, [mask, mask, None], _Stub(), SETTINGS, 3, progress=lambda *state: calls.append(state)
        )
    )
    assert result.class_ids.dtype == torch.int32
    assert result.class_ids.tolist() == [2, 0, 1, 2]
    assert result.margin.tolist() == pytest.approx([5 / 8, 0.0, 0.5, 0.75])
    assert result.never_seen.tolist() == [False, True, False, False]
    assert result[torch.tensor([True, False, False, True])].class_ids.tolist() == [2, 2]
    assert calls == [(1, 3), (2, 3), (3, 3)]


def test_small_weights_of_many_views_are_not_lost():
    cameras = [SimpleNamespace(table=[[1e8, 0.0]])] + [SimpleNamespace(table=[[0.0, 1.0]])] * 3
    result = by_largest(
        contributions(_surfels(1), cameras, [torch.zeros(1, 1, dtype=torch.int32)] * 4, _Stub(), SETTINGS, 2)
    )
    assert result.margin.item() == pytest.approx(1e8 / (1e8 + 3), abs=1e-7)


def test_contributions_are_image_derivatives():
    """C[i, c] summed over classes is d(sum of the image over labelled pixels) / d(colour of i)."""
    scene = make_scene()
    inputs = scene.inputs
    sh = torch.zeros(len(inputs.means), 1, 3).double()
    surfels = Surfels.of(inputs.means, inputs.quats, inputs.log_scales, inputs.opacity_logits, sh)
    rasterizer = make_rasterizer("torch")
    result = by_largest(
        contributions(surfels, [scene.camera] * 2, [scene.target, None], rasterizer, scene.settings, CLASSES)
    )
    colors = torch.zeros_like(inputs.means).requires_grad_()
    bare = geometry_inputs(surfels)
    coloured = type(bare)(bare.means, bare.quats, bare.log_scales, bare.opacity_logits, colors)
    rendered = rasterizer.rasterize(coloured, scene.camera, scene.settings, torch.zeros(3, dtype=torch.float64))
    sums = [rendered.color[..., 0][scene.target == c].sum() for c in range(CLASSES)]
    table = torch.stack([torch.autograd.grad(each, colors, retain_graph=True)[0][:, 0] for each in sums], 1)
    seen = table.sum(1) > 0
    assert 0 < seen.sum() < len(seen)
    assert torch.equal(result.never_seen, ~seen)
    assert torch.equal(result.class_ids[seen].long(), table.argmax(1)[seen])
    assert (result.class_ids[~seen] == 0).all() and (result.margin[~seen] == 0).all()
    assert torch.allclose(result.margin[seen], (table.max(1).values / table.sum(1))[seen].float())


def test_ids_out_of_range_are_refused():
    mask = torch.tensor([[0, IGNORE, 5]], dtype=torch.int32)
    with pytest.raises(UserError, match="view 0 holds class ids 0..5"):
        by_largest(contributions(_surfels(1), [SimpleNamespace(table=[[1.0]])], [mask], _Stub(), SETTINGS, 3))


@pytest.mark.parametrize("backend", ["torch", "native"])
@pytest.mark.parametrize("num_classes", [2, 256])
def test_lists_of_contributions_are_the_table(backend, num_classes):
    if reason := RASTERIZERS.get(backend).unavailable():
        pytest.skip(reason)
    scene = make_scene(count=300, width=71, height=51, size=-2.0)
    rasterizer, what = make_rasterizer(backend), (scene.inputs, scene.camera, scene.settings)
    labels = (torch.arange(71 * 51, dtype=torch.int32) // 40 % num_classes).reshape(51, 71)
    labels[3], labels[4] = IGNORE, -1
    table = rasterizer.class_contributions(*what, labels, num_classes)
    keys, values = rasterizer.sparse_class_contributions(*what, labels, num_classes)
    assert keys.dtype == torch.int64 and bool((keys.diff() > 0).all()) and bool((values != 0).all())
    again = torch.zeros_like(table).view(-1)
    again[keys] = values
    assert torch.equal(again.view_as(table), table)
    nothing = rasterizer.sparse_class_contributions(*what, torch.full_like(labels, IGNORE), num_classes)
    assert [len(value) for value in nothing] == [0, 0]
