"""Veils in held-out photos are found without ground truth, and things that stand before an object are none."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from run_folders import SETTINGS, discs, ring_cameras

from beags_plugin.core.membership import Membership
from beags_plugin.core.surfels import Surfels
from beags_plugin.evaluation.veils import hidden_share, veiled
from beags_plugin.rasterizers import make_rasterizer

CAMERAS = ring_cameras(9, 2)
HELD_OUT = (0, 8)


def with_veil(views: tuple[int, ...]) -> tuple[Surfels, Membership]:
    """Return the two clouds of discs, and a large background disc close before each of some cameras."""
    surfels, ids = discs()
    veils = []
    for view in views:
        camera = CAMERAS[view]
        one = Surfels(*(value[:1].clone() for value in vars(surfels).values()))
        ahead = camera.rotation[2].to(one.means)
        rotation = torch.nn.functional.normalize(torch.tensor([[1.0, 0.0, 0.0, 0.0]]))
        veils.append(
            replace(
                one,
                means=(camera.center.to(one.means) + 0.3 * ahead)[None],
                quats=_facing(camera.rotation).to(rotation),
                log_scales=torch.full_like(one.log_scales, 0.0),
                opacity_logits=torch.full_like(one.opacity_logits, 4.0),
            )
        )
    parts = [surfels, *veils]
    whole = Surfels(*(torch.cat(values) for values in zip(*(vars(part).values() for part in parts), strict=True)))
    return whole, Membership(torch.cat([ids, ids.new_zeros(len(veils))]))


def _facing(rotation: torch.Tensor) -> torch.Tensor:
    """Return the quaternion [1, 4], w first, whose axes are a camera's."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(rotation.T.double().numpy()).as_quat()
    return torch.tensor([[w, x, y, z]])


def found(views: tuple[int, ...], training: tuple[int, ...] = (1, 2, 3, 4, 5, 6, 7)) -> list[str]:
    surfels, members = with_veil(views)
    held_out = {f"v{view}": CAMERAS[view] for view in HELD_OUT}
    cameras = [CAMERAS[view] for view in training]
    return veiled(surfels, members, [1, 2], held_out, cameras, make_rasterizer("auto"), SETTINGS)


@pytest.mark.parametrize("views", [(), (0,), (8,), (0, 8)])
def test_a_veil_before_a_held_out_camera_is_found(views):
    assert found(views) == [f"v{view}" for view in views]


def test_what_hides_objects_in_training_photos_beside_it_too_is_no_veil():
    assert found((0, 1, 2, 3, 4, 5, 6, 7)) == []
    assert found((0, 1)) == [], "a thing on one side"


def test_objects_hide_one_another_and_a_class_without_gaussians_has_no_share():
    surfels, ids = discs()
    rasterizer = make_rasterizer("auto")
    shares = [hidden_share(surfels, Membership(ids), [1, 2], each, rasterizer, SETTINGS) for each in CAMERAS]
    assert max(shares) < 0.05, "a disc before another one is no veil"
    assert math.isnan(hidden_share(surfels, Membership(ids), [9], CAMERAS[0], rasterizer, SETTINGS))
