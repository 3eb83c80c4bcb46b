"""Phases and learning rates."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

pytest.importorskip("nerfstudio")

from beags_plugin.core.densification import grows_at, resets_at, scaled
from beags_plugin.core.schedule import PhaseSchedule, log_linear
from beags_plugin.losses import make_loss
from beags_plugin.options.loss_spec import LossSpec
from beags_plugin.options.stages import DensifyConfig
from beags_plugin.plugin.training.callbacks import camera_extent
from beags_plugin.plugin.training.scene_edits import move_adam_state


def test_refinement_repeats_the_last_tenth_of_the_base_schedule():
    schedule = PhaseSchedule(base_steps=30_000, refine_steps=3_000)
    assert schedule.progress(0) == 0.0
    assert schedule.progress(27_000) == pytest.approx(schedule.progress(30_000))
    assert schedule.progress(29_999) == pytest.approx(schedule.progress(32_999), abs=1e-4)
    assert schedule.refining(30_000) and not schedule.refining(29_999)


def test_the_schedule_of_a_polished_base_is_the_second_half():
    warm = PhaseSchedule(100, 10, 30_000, warm=True)
    assert [warm.progress(step) for step in (0, 50, 100, 105)] == [0.5, 0.75, 0.9, 0.95]


def test_positions_learn_log_linearly():
    assert log_linear(1.6e-4, 1.6e-6, 0.0) == pytest.approx(1.6e-4)
    assert log_linear(1.6e-4, 1.6e-6, 0.5) == pytest.approx(1.6e-5)
    assert log_linear(1.6e-4, 1.6e-6, 1.0) == pytest.approx(1.6e-6)


def test_extent_is_a_tenth_more_than_the_farthest_camera():
    poses = torch.eye(4)[:3].repeat(3, 1, 1)
    poses[:, 0, 3] = torch.tensor([-3.0, 0.0, 3.0])
    assert float(camera_extent(poses)) == pytest.approx(3.3)
    assert float(camera_extent(poses[:1])) == 1.0


def test_adam_moments_follow_their_gaussians():
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


# -- the official schedule, and shorter runs of it -------------------------------------------------------------------


@pytest.fixture(scope="module")
def model():
    """A model of the documented base config on a few random seed points."""
    from nerfstudio.data.scene_box import SceneBox

    from beags_plugin.plugin.options.config import base_config

    g = torch.Generator().manual_seed(1)
    points = (torch.randn(30, 3, generator=g), torch.randint(0, 256, (30, 3), generator=g))
    box = SceneBox(torch.tensor([[-1.0] * 3, [1.0] * 3]))
    return base_config().model_config.setup(scene_box=box, num_train_data=1, seed_points=points)


def steps_where(happens, config):
    return [done for done in range(1, 30_001) if happens(config, done)]


def test_the_official_steps_of_growth_and_resets():
    config = DensifyConfig()
    assert scaled(config, 1.0) == config
    assert steps_where(grows_at, config) == list(range(600, 15_000, 100))
    assert steps_where(resets_at, config) == [3_000, 6_000, 9_000, 12_000]
    assert not steps_where(resets_at, replace(config, reset_every=0))


def test_a_shorter_run_has_the_same_proportions_but_no_shorter_intervals_than_it_can_bear():
    half = scaled(DensifyConfig(), 0.5)
    assert (half.every, half.start, half.stop, half.reset_every, half.prune_scale_after) == (50, 250, 7500, 1500, 1500)
    short = scaled(DensifyConfig(), 0.1)
    assert (short.every, short.start, short.stop, short.reset_every, short.prune_scale_after) == (
        50,
        50,
        1500,
        1000,
        300,
    )
    never = scaled(DensifyConfig(reset_every=0, prune_scale_after=0, every=30), 0.1)
    # Steps stated shorter than the bound stay as stated.
    assert (never.reset_every, never.prune_scale_after, never.every) == (0, 0, 30)
    assert scaled(DensifyConfig(prune_scale_after=3), 0.1).prune_scale_after == 1  # 0 would be never


def test_stated_steps_are_scaled_with_the_length_of_the_base():
    assert PhaseSchedule(30_000, 3_000, 30_000).scaled(7_000) == 7_000
    assert PhaseSchedule(3_000, 300, 30_000).scaled(7_000) == 700
    assert PhaseSchedule(3_000, 300).scaled(7_000) == 7_000  # stated for this run
    assert PhaseSchedule(0, 3_000, 30_000).scaled(7_000) == 7_000  # no base to scale by
    assert PhaseSchedule(30, 0, 30_000).scaled(100) == 1 and PhaseSchedule(30, 0, 30_000).scaled(0) == 0
    short = PhaseSchedule(3_000, 300, 30_000)
    assert make_loss("normal", LossSpec(start=7_000), short).start == 700
    assert make_loss("boundary", LossSpec(start=50, phase="refine"), short).start == 3_050


def test_the_sh_degree_grows_by_one_every_thousand_steps(model):
    def degree(step, base_steps=30_000):
        model.step, model.schedule = step, PhaseSchedule(base_steps, 0, 30_000)
        return model.active_sh_degree()

    model.train()
    assert [degree(step) for step in (0, 999, 1000, 1999, 2000, 3000, 29_999)] == [0, 0, 1, 1, 2, 3, 3]
    assert [degree(step, 3_000) for step in (99, 100, 299, 300)] == [0, 1, 2, 3]


def test_the_official_losses_and_their_starts(model):
    model.schedule = PhaseSchedule(30_000, 0, 30_000)
    losses = {name: (loss.weight, loss.start) for name, loss in model.losses.items()}
    assert losses == {
        "photometric": (1.0, 0),
        "normal": (0.05, 7_000),
        "boundary": (0.5, 30_000),
        "occupancy": (10.0, 30_000),
    }
    assert model.losses["photometric"].ssim_weight == 0.2


def test_official_learning_rates(model):
    from beags_plugin.plugin.options.config import base_config
    from beags_plugin.plugin.training.callbacks import set_learning_rates

    configs = base_config().optimizers
    adam = torch.optim.Adam([{"params": [torch.nn.Parameter(torch.zeros(1))], "name": name} for name in configs])
    model.extent, model.schedule = torch.tensor(2.5), PhaseSchedule(30_000, 0, 30_000)

    def rates(step):
        set_learning_rates(model, adam, configs, step)
        return {group["name"]: group["lr"] for group in adam.param_groups}

    constant = {"features_dc": 2.5e-3, "features_rest": 1.25e-4, "opacities": 0.05, "scales": 0.005, "quats": 0.001}
    assert rates(0) == pytest.approx({"means": 2.5 * 1.6e-4, **constant})
    assert rates(15_000) == pytest.approx({"means": 2.5 * 1.6e-5, **constant})
    assert rates(29_999) == pytest.approx({"means": 2.5 * 1.6e-6, **constant}, rel=1e-3)
    assert all(group["eps"] == 1e-15 for group in adam.param_groups)
    configs["scales"]["optimizer"].eps = 1e-6  # Adam was made and loaded with another.
    rates(0)
    assert [group["name"] for group in adam.param_groups if group["eps"] != 1e-15] == ["scales"]
    model.schedule = PhaseSchedule(30_000, 3_000, 30_000)
    assert rates(30_000) == pytest.approx({"means": 2.5 * 1.6e-4 * 100**-0.9, **constant})

    def decays(step):
        rates(step)
        return {group["name"]: group["weight_decay"] for group in adam.param_groups if group["weight_decay"]}

    for name, own in (("features_rest", 0.5), ("scales", 0.25)):  # The group's own factor holds in all steps.
        configs[name]["optimizer"].weight_decay = own
    assert decays(0) == decays(30_000) == {"features_rest": 0.5, "scales": 0.25}
    for name in ("features_rest", "scales"):
        configs[name]["optimizer"].weight_decay = 0
    refined = rates(30_000)
    model.config.base_lr_factor = 4.0
    assert rates(30_000) == refined  # the base's alone, and not that of opacities
    found, official = rates(15_000), {"means": 2.5 * 1.6e-5, **constant}
    assert found == pytest.approx({name: rate * (1 if name == "opacities" else 4) for name, rate in official.items()})
    model.schedule = PhaseSchedule(30_000, 3_000, 30_000, warm=True)
    assert rates(0)["scales"] == pytest.approx(0.005)  # polishing learns little


def test_only_steps_of_growth_gather_gradients(model):
    from types import SimpleNamespace

    from nerfstudio.cameras.cameras import Cameras

    from beags_plugin.plugin.training.callbacks import Densifier

    pose = torch.eye(4)[None, :3]
    pose[0, 2, 3] = 4.0
    one = torch.tensor([40.0])
    camera = Cameras(pose, one, one, torch.tensor([16.0]), torch.tensor([12.0]), 32, 24)
    model.train()
    model.schedule, model.extent = PhaseSchedule(30_000, 0, 30_000), torch.tensor(1.0)
    data = SimpleNamespace(train_dataset=SimpleNamespace(cameras=camera), close_ups=None)
    densifier = Densifier(model, {}, data)

    def gathered(step):
        before = float(densifier.statistics.total.sum())
        model.step = step
        densifier.before_step(step)
        model.get_outputs(camera)["rgb"].square().sum().backward()
        densifier.after_step(step)
        return float(densifier.statistics.total.sum()) - before

    assert gathered(5_000) > 0  # no multiple of 100 steps is done: nothing grows
    assert float(densifier.statistics.views.max()) == 1
    assert gathered(14_997) > 0 and model.last_render.screen_shift is not None
    assert gathered(15_000) == 0 and model.last_render.screen_shift is None
    densifier.config = DensifyConfig(stop=10**9)
    assert gathered(29_999) == 0  # the last step of the base prepares for what follows
