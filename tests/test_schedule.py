"""Phases and learning rates."""

from __future__ import annotations

import pytest
import torch

pytest.importorskip("nerfstudio")

from beags_plugin.plugin.schedule import PhaseSchedule, log_linear
from beags_plugin.plugin.training import camera_extent, move_adam_state


def test_refinement_repeats_the_last_tenth_of_the_base_schedule():
    schedule = PhaseSchedule(base_steps=30_000, refine_steps=3_000)
    assert schedule.progress(0) == 0.0
    assert schedule.progress(27_000) == pytest.approx(schedule.progress(30_000))
    assert schedule.progress(29_999) == pytest.approx(schedule.progress(32_999), abs=1e-4)
    assert schedule.refining(30_000) and not schedule.refining(29_999)


def test_positions_learn_log_linearly():
    assert log_linear(1.6e-4, 1.6e-6, 0.0) == pytest.approx(1.6e-4)
    assert log_linear(1.6e-4, 1.6e-6, 0.5) == pytest.approx(1.6e-5)
    assert log_linear(1.6e-4, 1.6e-6, 1.0) == pytest.approx(1.6e-6)


def test_extent_is_a_tenth_more_than_the_farthest_camera():
    poses = torch.eye(4)[:3].repeat(3, 1, 1)
    poses[:, 0, 3] = torch.tensor([-3.0, 0.0, 3.0])
    assert float(camera_extent(poses)) == pytest.approx(3.3)
    assert float(camera_extent(poses[:1])) == 1.0


def test_adam_moments_follow_their_surfels():
    parameter = torch.nn.Parameter(torch.arange(3.0))
    optimizer = torch.optim.Adam([parameter], lr=0.1)
    parameter.grad = torch.tensor([1.0, 2.0, 3.0])
    optimizer.step()
    before = optimizer.state[parameter]["exp_avg"].clone()
    former, parameter = parameter, torch.nn.Parameter(torch.zeros(4))
    move_adam_state(optimizer, former, parameter, torch.tensor([2, 0, 0, 1]), torch.tensor([False, False, True, False]))
    expected = torch.stack([before[2], before[0], torch.zeros(()), before[1]])
    assert torch.equal(optimizer.state[parameter]["exp_avg"], expected)
    parameter.grad = torch.ones(4)
    optimizer.step()
    assert torch.isfinite(parameter).all() and bool((parameter != 0).all())
    assert len(optimizer.state) == 1
