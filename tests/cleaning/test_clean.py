"""What does not belong to an object: drawn scenes whose masks are known."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from random_surfels import SETTINGS, camera_at

from beags_plugin.cleaning.clean import OUTSIDE, LeftOut, clean
from beags_plugin.cleaning.parts import connected_parts
from beags_plugin.cleaning.silhouettes import MaskedViews
from beags_plugin.core.surfels import Surfels
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.rasterizers.rendering import geometry_inputs, render_class_map
from beags_plugin.splat_io.frames import quat_from_rotation

RASTERIZER = make_rasterizer("auto")
CAMERAS = [
    camera_at((3 * math.cos(a), 3 * math.sin(a), height), pixels=64)
    for a, height in zip(torch.linspace(0, 5.8, 12).tolist(), 6 * [0.5, 1.5], strict=True)
]


def disc(center, normal, scales, opacity: float = 0.95) -> Surfels:
    """One disc; its first axis lies along x as far as its normal lets it."""
    normal = torch.nn.functional.normalize(torch.tensor(normal, dtype=torch.float64), dim=0)
    first = torch.tensor([1.0, 0.0, 0.0] if abs(normal[0]) < 0.9 else [0.0, 1.0, 0.0], dtype=torch.float64)
    first = torch.nn.functional.normalize(first - (first @ normal) * normal, dim=0)
    rotation = torch.stack([first, torch.linalg.cross(normal, first), normal], dim=1)
    return Surfels.of(
        torch.tensor([center], dtype=torch.float32),
        quat_from_rotation(rotation)[None].float(),
        torch.tensor([scales]).log(),
        torch.tensor([math.log(opacity / (1 - opacity))]),
        torch.zeros(1, 1, 3),
    )


def joined(*parts: Surfels) -> Surfels:
    return Surfels.of(*(torch.cat([getattr(each, name) for each in parts]) for name in
                        ("means", "quats", "log_scales", "opacity_logits", "sh")))  # fmt: skip


def ball(center=(0.0, 0.0, 0.0), radius: float = 0.5, count: int = 200) -> Surfels:
    """Opaque discs all over a sphere."""
    found = []
    for index in range(count):
        z, angle = 1 - 2 * (index + 0.5) / count, index * math.pi * (3 - 5**0.5)
        normal = (math.sqrt(1 - z * z) * math.cos(angle), math.sqrt(1 - z * z) * math.sin(angle), z)
        place = [c + radius * n for c, n in zip(center, normal, strict=True)]
        found.append(disc(place, normal, (0.12 * radius, 0.12 * radius)))
    return joined(*found)


def views(true: Surfels, classes: torch.Tensor, drawn: Surfels) -> MaskedViews:
    """Masks of the true scene, with the depth of the one that was trained."""
    labels, depths = [], []
    for camera in CAMERAS:
        class_map, _ = render_class_map(RASTERIZER, true, classes, camera, SETTINGS)
        solid = RASTERIZER.rasterize(geometry_inputs(true), camera, SETTINGS, torch.zeros(3)).alpha > 0.5
        labels.append(torch.where(solid, class_map, 0).int())
        depth = RASTERIZER.rasterize(geometry_inputs(drawn), camera, SETTINGS, torch.zeros(3)).median_depth
        assert depth is not None
        depths.append(depth)
    return MaskedViews(CAMERAS, labels, depths, RASTERIZER, SETTINGS)


def ones(surfels: Surfels) -> torch.Tensor:
    return torch.ones(len(surfels), dtype=torch.int32)


def test_a_clean_object_stays_whole():
    body = ball()
    keep, left_out = clean(body, 1, views(body, ones(body), body))
    assert keep.tolist() == list(range(200)) and str(left_out) == "nothing left out"


CHIP = joined(*(disc((1.0, 0.02 * i, 0.0), (0, 0, 1), (0.03, 0.03)) for i in range(4)))
SPIKE = disc((0.7, 0.0, 0.2), (0, 0, 1), (0.3, 0.02))
FAINT = disc((0.3, 0.0, 0.3), (0, 1, 0), (0.6, 0.6), opacity=0.1)


@pytest.mark.parametrize("stray", [CHIP, SPIKE, FAINT], ids=["chip", "spike", "oversized faint disc"])
def test_what_leaves_the_masks_is_left_out(stray):
    body = ball()
    part = joined(body, stray)
    keep, left_out = clean(part, 1, views(body, ones(body), part))
    assert keep.tolist() == list(range(200)) and left_out == LeftOut(outside=len(stray))
    assert str(left_out) == f"{len(stray)} that reach outside its masks left out"


def test_a_chip_that_others_hide_in_every_photo_is_left_out():
    """It lies inside another object: nothing shows it, and nothing that hangs together with the object."""
    body, other, chip = ball((0, 0, -0.4), 0.3), ball((0, 0, 0.5), 0.3), ball((0, 0, 0.5), 0.05, 6)
    true = joined(body, other)
    classes = torch.cat([ones(body), 2 * ones(other)])
    part = joined(body, chip)
    keep, left_out = clean(part, 1, views(true, classes, joined(true, chip)))
    assert keep.tolist() == list(range(200)) and left_out == LeftOut(loose=6)
    assert str(left_out) == "6 in specks and loose parts that hardly any mask supports left out"


def test_a_part_that_masks_show_apart_stays():
    """A lid beside its pot, and one of which other things hide most."""
    pot, lid = ball((-0.4, 0, 0), 0.4), ball((0.7, 0, 0), 0.1, 20)
    both = joined(pot, lid)
    assert len(set(connected_parts(both).tolist())) == 2
    assert len(clean(both, 1, views(both, ones(both), both))[0]) == 220
    screen = joined(*(disc((0.7, y, 0.25), (0, 0, 1), (0.1, 0.1)) for y in (-0.2, 0.0, 0.2)))
    scene = joined(both, screen)
    masked = views(scene, torch.cat([ones(both), 2 * ones(screen)]), scene)
    hidden = masked.evidence(both, 1)[200:, 2].sum()
    assert hidden > 0 and len(clean(both, 1, masked)[0]) == 220


def test_a_chip_that_a_few_masks_take_for_the_object_is_left_out():
    """Another thing hides it in half of the views; what all masks show stays, and what is near."""
    body, chip = ball(), ball((1.3, 0.0, 0.0), 0.02, 6)
    scene = joined(body, chip)
    assert len(clean(scene, 1, views(scene, ones(scene), scene))[0]) == 206
    screen = ball((1.3, 0.0, 0.0), 0.15, 60)
    screen = screen[screen.means[:, 1] < 0.06]  # a good half of a shell
    whole = joined(scene, screen)
    masked = views(whole, torch.cat([ones(scene), 2 * ones(screen)]), whole)
    inside, outside, hidden, _ = masked.evidence(scene, 1)[200:].sum(axis=0)
    assert outside + hidden < inside < 2 * (outside + hidden)
    keep, left_out = clean(scene, 1, masked)
    assert keep.tolist() == list(range(200)) and left_out == LeftOut(loose=6)
    near = joined(body, ball((0.6, 0.0, 0.0), 0.03, 6))
    assert len(set(connected_parts(near).tolist())) == 2
    assert len(clean(near, 1, views(near, ones(near), near))[0]) == 206


def test_a_speck_far_from_the_object_is_left_out_whatever_the_masks_say():
    body = ball(radius=0.8)
    far, near = (joined(body, ball((x, 0.0, 0.0), 0.01, 1)) for x in (1.3, 0.85))
    for scene, kept in ((far, 200), (near, 201)):
        assert len(clean(scene, 1, views(scene, ones(scene), scene))[0]) == kept


def test_a_disc_without_which_the_object_had_a_hole_stays():
    body = ball()
    body = body[body.means[:, 2] < 0.35]
    cap = disc((0.0, 0.0, 0.37), (0, 0, 1), (0.5, 0.5))
    part, masked = joined(body, cap), views(ball(), ones(ball()), ball())
    inside, outside, _, beside = masked.evidence(part, 1)[-1]
    assert outside >= OUTSIDE * (inside + outside + beside), "the cap leaves the hull"
    holes, cleared = masked.flips(part, body, 1)[-1]
    assert holes > cleared > 0
    assert len(part) - 1 in clean(part, 1, masked)[0].tolist()


def test_an_object_of_ten_gaussians():
    body = ball(count=10, radius=0.2)
    part = joined(body, CHIP)
    keep, left_out = clean(part, 1, views(body, ones(body), part))
    assert keep.tolist() == list(range(10)) and left_out.outside == 4


def test_an_object_that_its_masks_contradict_stays_whole_and_says_so():
    body, other = ball(), ball((1.0, 0.6, 0.0), 0.2)
    keep, left_out = clean(body, 1, views(other, ones(other), joined(body, other)))
    assert len(keep) == 200 and str(left_out).startswith("nothing left out, as its masks contradict ")
    # masks that say nothing remove nothing
    blank = views(body, ones(body), body)
    blank = replace(blank, labels=[torch.full_like(each, 65535) for each in blank.labels])
    assert len(clean(joined(body, CHIP), 1, blank)[0]) == 204


def test_neither_order_nor_threads_matter():
    body = ball()
    part = joined(body, CHIP, SPIKE)
    masked = views(body, ones(body), part)
    keep, left_out = clean(part, 1, masked)
    order = torch.randperm(len(part), generator=torch.Generator().manual_seed(3))
    again, same = clean(part[order], 1, masked)
    assert same == left_out and sorted(order[again].tolist()) == keep.tolist()
    threads, evidence = torch.get_num_threads(), masked.evidence(part, 1)
    try:
        for count in (1, 3):
            torch.set_num_threads(count)
            assert (masked.evidence(part, 1) == evidence).all()
    finally:
        torch.set_num_threads(threads)


def test_parts():
    near = joined(*(disc((0.1 * i, 0, 0), (0, 0, 1), (0.03, 0.03)) for i in range(11)))
    assert set(connected_parts(near).tolist()) == {0}
    gap = near[torch.tensor([0, 1, 2, 3, 7, 8, 9, 10])]
    assert len(set(connected_parts(gap).tolist())) == 2
    bridge = disc((0.5, 0, 0), (0, 0, 1), (0.1, 0.01))
    assert set(connected_parts(joined(gap, bridge)).tolist()) == {0}
    faint = disc((0.2, 0, 0), (0, 0, 1), (0.1, 0.1), opacity=0.003)
    broken = disc((math.nan, 0, 0), (0, 0, 1), (1.0, 1.0))
    far = disc((1e15, 0, 0), (0, 0, 1), (0.1, 0.1))
    found = connected_parts(joined(near, faint, broken, far)).tolist()
    assert found[11:13] == [-1, -1] and found[13] != found[0]
    assert connected_parts(near[:1]).tolist() == [0] and connected_parts(near[:0]).tolist() == []
