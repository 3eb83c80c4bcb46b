"""Curves that a run writes for tensorboard, read back from its event files."""

from __future__ import annotations

import json
import time
from contextlib import contextmanager, suppress

import numpy as np
import pytest
import torch

pytest.importorskip("nerfstudio")

from resumed_runs import STEPS, Killed, resume_to_end, run_to_end, short_config
from run_folders import CLASSES, discs, write_scene

from beags_plugin.core.rotations import rotation_from_quat
from beags_plugin.evaluation.violations import boundary_errors, occupancy_violations
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.occupancy.grid import VisibilityGrid
from beags_plugin.plugin.trainer import BeagsTrainer
from beags_plugin.plugin.training.timing import Estimate
from beags_plugin.preparation import pipeline as preparation

LAST = sum(STEPS) - 1
BARS: list[tuple[str, list[tuple[int, int]]]] = []  # names and steps of the progress bars of ``run``


def resume_in_another_second(run):
    """Resume as another process would: tensorboard sorts the files that one process begins in one second wrongly."""
    second = int(time.time())
    while int(time.time()) == second:
        time.sleep(0.05)
    resume_to_end(run)


def events_of(run):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(run), size_guidance={"scalars": 0, "images": 0})
    events.Reload()
    return events


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return write_scene(tmp_path_factory.mktemp("data"))


@pytest.fixture(scope="module")
def run(data, tmp_path_factory):
    run = tmp_path_factory.mktemp("curves") / "run"
    config = short_config(data, run, steps_per_objects=5)
    config.logging.steps_per_log = 3

    @contextmanager
    def bar(name, passing=False):
        assert passing
        steps: list[tuple[int, int]] = []
        BARS.append((name, steps))
        yield lambda *step: steps.append(step)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("beags_plugin.plugin.training.monitor.progress_bar", bar)
        run_to_end(config)
    return run


@pytest.mark.parametrize(
    ("method", "chosen", "told"), [("beags", True, True), ("beags", False, False), ("beags-tiny", True, False)]
)
def test_a_quicker_preset_is_named_to_who_can_choose_one(capsys, method, chosen, told):
    estimate = Estimate(method, 10**9, chosen)
    estimate.before_step(20)
    estimate._from -= 3600.0
    estimate.before_step(120)
    assert capsys.readouterr().out.replace("\n", " ").count("Quicker: ns-train beags-tiny") == 2 * told


def test_the_objects_have_a_bar(run):
    """Two objects in two held-out views, and a picture of each."""
    whole = [(done, 6) for done in range(1, 7)]
    objects = [done for name, done in BARS if name == "Measuring objects"]
    assert len(objects) == 4 and all(done == whole for done in objects)


def test_every_curve_and_picture_is_in_the_event_file(run):
    events = events_of(run)
    scalars = {tag: events.Scalars(tag) for tag in events.Tags()["scalars"]}
    assert all(np.isfinite(event.value) for each in scalars.values() for event in each)
    for term in ("photometric", "normal", "boundary", "occupancy"):
        assert f"Train Loss Dict/{term}" in scalars
    assert {"Train Metrics Dict/gaussian_count", "Train Metrics Dict/psnr", "Eval Images Metrics/psnr"} <= set(scalars)
    refining = {f"Boundary error/{name}" for name in CLASSES.values()}
    violations = {f"Occupancy violation/{name}" for name in CLASSES.values() if name != "background"}
    assert violations == {tag for tag in scalars if tag.startswith("Occupancy violation/")}
    refining |= violations
    for tag in refining:
        assert all(event.step >= STEPS[0] - 1 and 0.0 <= event.value <= 1.0 for event in scalars[tag]), tag
    iou = {name: [(e.step, e.value) for e in scalars[f"Extracted IoU/{name}"]] for name in ("cup", "box", "mean")}
    assert [step for step, _ in iou["mean"]] == [44, 49, 54, LAST]  # The first, every 5th, and the last.
    assert all(0.0 <= value <= 1.0 for each in iou.values() for _, value in each)
    now, peak = scalars["Memory (MB)/now"], scalars["Memory (MB)/peak"]
    assert all(100 < a.value <= b.value + 1 for a, b in zip(now, peak, strict=True))
    assert [event.step for event in now] == list(range(0, LAST + 1, 3))
    images = events.Tags()["images"]
    assert {"Scene/class map", "Objects/cup", "Objects/box"} <= set(images)
    assert [event.step for event in events.Images("Objects/cup")] == [44, 49, 54, LAST]


def test_the_last_iou_is_that_of_the_evaluation(run):
    from beags_plugin.objects.evaluate import evaluate_run

    metrics = evaluate_run(run / "config.yml").after
    events = events_of(run)
    assert len(metrics.views) <= 4  # all of them are looked at
    for index, name in ((1, "cup"), (2, "box")):
        assert events.Scalars(f"Extracted IoU/{name}")[-1].value == pytest.approx(
            metrics.objects[index].extracted.iou, abs=1e-6
        )


def killed(*_, **__):
    raise Killed


def kill_and_resume(config, monkeypatch, where):
    """Train to a step, or the preparation, and resume from there to the end."""
    train = BeagsTrainer.train_iteration
    with monkeypatch.context() as patch, pytest.raises(Killed):
        if where == "preparation":
            patch.setattr(preparation, "contributions", killed)
        patch.setattr(
            BeagsTrainer, "train_iteration", lambda self, step: killed() if step == where else train(self, step)
        )
        run_to_end(config)
    resume_in_another_second(config.run_dir)


@pytest.mark.parametrize("at", [5, 26])  # These steps lie before and after the first checkpoint.
def test_a_resumed_run_has_each_step_once(data, tmp_path, monkeypatch, at):
    run = tmp_path / "run"
    config = short_config(data, run)
    config.logging.steps_per_log = 1
    kill_and_resume(config, monkeypatch, at)
    assert [event.step for event in events_of(run).Scalars("Train Loss")] == list(range(LAST + 1))


@pytest.mark.parametrize("where", ["preparation", 53])
def test_a_resumed_run_has_the_iou_of_the_whole_one(data, run, tmp_path, monkeypatch, where):
    kill_and_resume(short_config(data, tmp_path / "run", steps_per_objects=5), monkeypatch, where)
    whole, resumed = (
        {(event.step, event.value) for event in events_of(folder).Scalars("Extracted IoU/mean")}
        for folder in (run, tmp_path / "run")
    )
    assert resumed == whole


def test_a_bad_held_out_mask_leaves_out_curves_only(data, tmp_path, monkeypatch, capsys):
    from beags_plugin.system.errors import UserError
    from beags_plugin.views.held_out_views import HeldOutViews

    def bad(self, index):
        raise UserError("the mask view.png has other proportions.")

    monkeypatch.setattr(HeldOutViews, "_view", bad)
    run_to_end(short_config(data, tmp_path / "run", steps_per_objects=5))
    assert (tmp_path / "run" / "training.json").exists()
    assert capsys.readouterr().out.count("has other proportions") == 1
    tags = events_of(tmp_path / "run").Tags()["scalars"]
    assert "Extracted IoU/mean" not in tags and "Occupancy violation/cup" in tags


def wandb_history(folder):
    """Return what wandb wrote to its own file in ``folder``, without a server: step to values by name."""
    from wandb.proto import wandb_internal_pb2
    from wandb.sdk.internal.datastore import DataStore

    (file,) = folder.rglob("*.wandb")
    store, history = DataStore(), {}
    store.open_for_scan(str(file))
    with suppress(AssertionError):  # A record may be incomplete as yet.
        while (data := store.scan_data()) is not None:
            record = wandb_internal_pb2.Record()
            record.ParseFromString(data)
            if record.WhichOneof("record_type") == "history":
                items = record.history.item
                values = {"/".join(item.nested_key) or item.key: json.loads(item.value_json) for item in items}
                history[values["_step"]] = values
    return history


@pytest.mark.slow("starts wandb's service")
def test_wandb_gets_the_same(data, run, tmp_path, monkeypatch):
    """Its real client, offline: each value of tensorboard's, at its step; pictures as files."""
    wandb = pytest.importorskip("wandb")
    for name, value in {"MODE": "offline", "SILENT": "true", "DIR": str(tmp_path)}.items():
        monkeypatch.setenv(f"WANDB_{name}", value)
    config = short_config(data, tmp_path / "run", vis="wandb", steps_per_objects=5)
    config.logging.steps_per_log = 3
    run_to_end(config)
    wandb.finish()
    end = time.monotonic() + 120
    while LAST not in (history := wandb_history(tmp_path)):  # its own process may still write
        assert time.monotonic() < end
        time.sleep(0.2)
    events = events_of(run)
    clocks = ("Memory", "GPU", "Train Iter", "Train Total", "ETA")
    clocks += ("Train Rays", "Test Rays", "Vis Rays")
    tags = [tag for tag in events.Tags()["scalars"] if not tag.startswith(clocks)]
    values = [(tag, event) for tag in tags for event in events.Scalars(tag)]
    for tag, event in values:
        assert history[event.step][tag] == pytest.approx(event.value, rel=1e-5), (tag, event.step)
    assert len(values) > 100 and "Extracted IoU/mean" in history[LAST]
    assert any("Memory (MB)/now" in each for each in history.values())
    picture = tmp_path.rglob(history[LAST]["Objects/cup/path"])
    assert len(list(picture)) == 1


def test_boundary_errors_are_means_over_the_pixels_of_a_class():
    labels = torch.tensor([[0, 0, 7], [900, 7, IGNORE]], dtype=torch.int32)
    boundary = torch.tensor([[0.2, 0.4, 0.0], [1.0, 0.5, 0.0]])
    assert boundary_errors(boundary, labels) == pytest.approx({0: 0.3, 7: 0.25, 900: 1.0})
    assert boundary_errors(boundary, torch.full_like(labels, IGNORE)) == {}


def test_occupancy_violations_are_the_share_of_matter_outside():
    """Each share is compared with a plain sum over many points, from another generator."""
    surfels, ids = discs()
    grid = VisibilityGrid.from_points([(surfels.means[ids != 2], ids[ids != 2])], 0.05, torch.zeros(3), 3)
    found = occupancy_violations(surfels, ids, grid, seed=1, step=2, samples=400)
    assert found[2] == pytest.approx(1.0)  # its class was never seen
    g = torch.Generator().manual_seed(5)
    radius = 3 * torch.rand(len(ids), 4000, generator=g).sqrt()
    angle = 6.2831853 * torch.rand(len(ids), 4000, generator=g)
    u, v = radius * angle.cos(), radius * angle.sin()
    axes = surfels.log_scales.exp()[:, None, :] * rotation_from_quat(surfels.quats)[..., :2]
    points = surfels.means[:, None] + u[..., None] * axes[:, None, :, 0] + v[..., None] * axes[:, None, :, 1]
    inside = grid.count(points.reshape(-1, 3), ids.repeat_interleave(4000)).view_as(u) > 0
    weight = torch.sigmoid(surfels.opacity_logits)[:, None] * torch.exp(-0.5 * (u * u + v * v))
    for index in (0, 1):
        expected = float(weight[ids == index][~inside[ids == index]].sum() / weight[ids == index].sum())
        assert 0.05 < expected < 0.95
        assert found[index] == pytest.approx(expected, abs=0.02)


@pytest.mark.parametrize("background", [True, False])
def test_the_sums_are_those_of_the_loss(background):
    """With the same seed and step, opacity times what lies outside, over all points, is the loss."""
    from beags_plugin.losses.base import LossInputs
    from beags_plugin.losses.occupancy import OccupancyLoss
    from beags_plugin.occupancy.violation import disc_sums

    surfels, ids = discs()
    grid = VisibilityGrid.from_points([(surfels.means[ids != 2], ids[ids != 2])], 0.05, torch.zeros(3), 3)
    sums = disc_sums(surfels, ids, grid, 7, background, seed=3, step=4)
    value = (torch.sigmoid(surfels.opacity_logits) * sums.wrong).sum() / (7 * len(ids))
    loss = OccupancyLoss(samples=7, background=background)
    inputs = LossInputs(4, 3, surfels, None, None, None, class_ids=ids, grid=grid)
    assert float(value) == pytest.approx(float(loss.value(inputs)), rel=1e-5) and float(value) > 0.01
