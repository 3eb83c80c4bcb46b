"""COB-GS's mask phase: the specification's numbers, and that no drawing is needed for its steps."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from drawn_discs import camera, discs, drawn
from raster_scenes import make_scene

from beags_baselines import mask_logits
from beags_baselines.mask_logits import MaskLogits, claim, mean_agreement, object_order, play_phase, to_split
from beags_plugin.core.cameras import Camera
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.rasterizers.torch_reference import TorchRasterizer
from beags_plugin.system.errors import UserError
from beags_plugin.system.filed_tensors import filed

SIDE = 64  # columns from 32 on are inside the mask
CENTERS = [32, 36, 38, 46]
COUNTS = torch.tensor([[270, 374, 422, 540, 0], [270, 166, 118, 0, 0]])  # (n_in, n_out); the last is behind the camera


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def played(sums, views: int, phases: int = 1, **options) -> MaskLogits:
    """The logits after phases over views that all have the same sums."""
    logits = MaskLogits(torch.zeros(sums.shape[1]))
    for _ in range(phases):
        play_phase(logits, lambda _: sums, [SIDE * SIDE] * views, generator(), **options)
    return logits


def test_the_table_of_counts():
    """Single discs of sigma 4 px and opacity 0.8, each drawn alone."""
    sums, counts = torch.zeros(2, 5), torch.zeros(2, 5, dtype=torch.int64)
    for place, x in enumerate(CENTERS):
        alpha = drawn(discs(SIDE, [(x, 32)], 4.0, 0.8), camera(SIDE)).alpha
        for row, part in enumerate((alpha[:, 32:], alpha[:, :32])):
            sums[row, place], counts[row, place] = part.sum(), (part > 0).sum()
    assert torch.equal(counts, COUNTS)
    assert (sums[0] / sums.sum(dim=0))[:4].tolist() == pytest.approx([0.5, 0.843, 0.935, 1.0], abs=6e-4)
    agreement = mean_agreement([counts] * 3)  # views that are all alike
    assert agreement.tolist() == pytest.approx([0.0, 0.385, 0.563, 1.0, 1.0], abs=6e-4)
    assert mean_agreement([sums])[1:3].tolist() == pytest.approx([0.686, 0.870], abs=6e-4)  # another method

    logits = played(sums, views=12)
    assert logits.logits[3:].tolist() == pytest.approx([2.157, 0.0], abs=6e-4)
    assert float(logits.logits[4]) == 0.0 and (logits.logits.sigmoid() > 0.9).tolist() == [False] * 5


def test_who_is_split_and_who_is_removed():
    agreement = mean_agreement([COUNTS] * 12)
    large, extent = torch.full((5, 2), math.log(0.04)), 3.9  # 0.04 is more than a hundredth of it
    assert to_split(agreement, large, extent, tau=0.5).tolist() == [True, True, False, False, False]
    assert to_split(agreement, large, extent).tolist() == [True, True, True, False, False]  # tau 0.8
    assert not to_split(agreement, large, 4.1).any()  # they are too small for it
    one_axis = torch.stack([large[:, 0], large[:, 0] - 9], dim=1)  # the larger scale decides
    assert to_split(agreement, one_axis, extent).tolist() == [True, True, True, False, False]
    assert mask_logits.mixed(agreement, 0.5).tolist() == [
        True,
        True,
        False,
        False,
        False,
    ]  # 3 of 5 stay, whatever their size


def test_a_view_that_does_not_show_a_gaussian_counts_as_agreeing():
    never = torch.zeros(2, 5)
    agreement = mean_agreement([COUNTS, never, never, never, never])
    assert agreement.tolist() == pytest.approx([0.8, 0.877, 0.9125, 1.0, 1.0], abs=1e-3)  # 1 - q, seen in a share q


def test_few_views_need_more_epochs():
    one_sided = torch.tensor([[9.0], [0.0]])
    for phases, epochs, logit, share in ((1, 2, 2.157, 0.8963), (4, 2, None, None), (1, 4, None, None)):
        logits = played(one_sided, 12, phases, epochs=epochs)
        if logit:
            assert float(logits.logits) == pytest.approx(logit, abs=6e-4)
            assert float(logits.logits.sigmoid()) == pytest.approx(share, abs=6e-5)
        assert bool(logits.logits.sigmoid() > 0.9) == (logit is None)
    steps = MaskLogits(torch.zeros(1))
    for _ in range(24):
        steps.step(torch.tensor([-1.0]))
    # A port that also takes the last step would find this.
    assert float(steps.logits) == pytest.approx(2.235, abs=6e-4)
    assert float(steps.logits.sigmoid()) == pytest.approx(0.9033, abs=6e-5)
    assert [mask_logits.phase_epochs(views) for views in (1, 12, 23, 24, 300)] == [48, 4, 3, 2, 2]


@pytest.mark.parametrize(("views", "share"), [(20, 0.67), (300, 0.92)])
def test_a_gaussian_that_one_view_alone_shows_ends_short_of_the_object(views, share):
    """Gaussian i shows in view i: it is pushed twice, and the momentum goes on for as long as the order leaves it."""
    logits, pushes = MaskLogits(torch.zeros(views)), 1e-3 * torch.eye(views)
    play_phase(logits, lambda view: (pushes[view], torch.zeros(views)), [100] * views, generator())
    assert float(logits.logits.sigmoid().median()) == pytest.approx(share, abs=0.01)


def views_of_a_scene():
    """A tiny scene in three views of different sizes, with masks of an object and pixels without label."""
    scene = make_scene(count=12, size=-1.0)
    K = scene.camera.K
    for width, height, shift in ((37, 29, 0.0), (24, 29, 0.3), (30, 18, -0.2)):
        moved = scene.camera.viewmat.clone()
        moved[0, 3] += shift
        target = scene.target[:height, :width]
        yield replace(scene, camera=Camera(moved, K, width, height), target=target)


def test_the_steps_equal_those_of_drawing_with_gradients():
    class_id, scenes = 1, list(views_of_a_scene())
    rasterizer, black = TorchRasterizer(), torch.zeros(3, dtype=torch.float64)
    count, outside_weight = len(scenes[0].inputs.means), 0.7
    m = torch.zeros(count, dtype=torch.float64, requires_grad=True)
    adam = torch.optim.Adam([m], lr=0.1, betas=(0.9, 0.999), eps=1e-15)
    order = mask_logits.shuffled(3, 2, generator(4))
    assert sorted(order[:3]) == sorted(order[3:]) == [0, 1, 2]
    for view in order[:-1]:
        scene = scenes[view]
        picture = scene.draw(rasterizer, colors=m.sigmoid()[:, None].expand(count, 3), background=black).color[..., 0]
        outside = torch.where(scene.target == IGNORE, 0.0, outside_weight)
        loss = (picture * torch.where(scene.target == class_id, -1.0, outside)).sum() / picture.numel()
        adam.zero_grad()
        loss.backward()
        adam.step()

    def sums(scene):
        table = rasterizer.class_contributions(scene.inputs, scene.camera, scene.settings, scene.target, 4)
        return torch.stack([table[:, class_id], table.sum(dim=1) - table[:, class_id]])

    logits = MaskLogits(torch.zeros(count, dtype=torch.float64))
    pixels = [scene.target.numel() for scene in scenes]
    play_phase(logits, filed(map(sums, scenes)).__getitem__, pixels, generator(4), outside_weight=outside_weight)
    assert float((logits.logits - m.detach()).abs().max()) < 1e-5
    assert float(m.detach().abs().min()) < 0.3 < float(m.detach().abs().max())  # not all steps had one sign


def test_without_edits_the_object_is_what_lies_mostly_inside():
    """FlashSplat's argmax; 60 views, in each of which a Gaussian lies inside or outside as a whole, and four phases."""
    inside = (torch.rand(60, 2_000, generator=generator()) < torch.rand(2_000, generator=generator(1))).float()
    share, logits = inside.mean(dim=0), MaskLogits(torch.zeros(2_000))
    for phase in range(4):
        play_phase(logits, lambda view: (inside[view], 1.0 - inside[view]), [100] * 60, generator(phase))
    differ = (logits.logits.sigmoid() > 0.9) != (share > 0.5)
    assert float((share[differ] - 0.5).abs().max()) < 0.05


def test_edits_and_checkpoints():
    logits = played(torch.tensor([[9.0, 0.0, 2.0], [0.0, 9.0, 2.1]]), 12)
    before = logits.state()
    logits.follow(torch.tensor([1, 2, 2, 0]), torch.tensor([False, True, True, False]))
    for name in ("logits", "exp_avg", "exp_avg_sq"):
        first, second = before[name][:2].tolist()
        assert logits.state()[name].tolist() == [second, 0.0, 0.0, first]
    assert float(logits.state()["step"]) == 23.0

    again = MaskLogits(torch.zeros(9))
    again.restore(logits.state())
    for each in (logits, again):
        each.step(torch.tensor([1.0, -2.0, 0.0, 3.0]))
    for name, values in logits.state().items():
        assert torch.equal(values, again.state()[name]), name
    # bias correction of step 24: a child's first step is by far not the rate
    assert float(again.logits[1]) == pytest.approx(0.1 * (0.1 / (1 - 0.9**24)) / (0.001 / (1 - 0.999**24)) ** 0.5)


def test_objects_of_one_scene_take_turns():
    areas = {1: 40, 2: 90, 3: 90, 7: 5}
    orders = {order: object_order(areas, order) for order in mask_logits.ORDERS}
    assert orders == {"area_desc": [2, 3, 1, 7], "area_asc": [7, 1, 2, 3], "label_asc": [1, 2, 3, 7]}
    with pytest.raises(UserError, match="area_dsc"):
        object_order(areas, "area_dsc")
    p = torch.tensor([[0.95, 0.95, 0.9, 0.2], [0.96, 0.94, 0.93, 0.89]], dtype=torch.float64)
    ids, scores = torch.zeros(4, dtype=torch.int32), torch.zeros(4, dtype=torch.float64)
    for class_id, shares in zip((2, 1), p, strict=True):
        ids, scores = claim(ids, scores, shares.logit() - 1e-9, class_id)
    assert ids.tolist() == [1, 2, 1, 0] and ids.dtype == torch.int32
    assert scores.tolist() == pytest.approx([0.96, 0.95, 0.93, 0.0])
