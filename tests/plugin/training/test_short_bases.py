"""What shortens a base: small photos first, faster rates, pruning of what too few views show."""

from __future__ import annotations

import pytest
import torch

pytest.importorskip("nerfstudio")

from resumed_runs import STEPS, Killed, assert_same_run, checkpoint_of, interrupted, kill_at, resume_to_end, run_to_end
from resumed_runs import short_config as usual_config

from beags_plugin.plugin.options import pyramid
from beags_plugin.plugin.training import densifier

SHORT = {
    "pipeline.model.pyramid.start": 3.0,
    "pipeline.model.pyramid.until": 0.8,
    "pipeline.model.pyramid.levels": 3,
    "pipeline.model.base_lr_factor": 3.0,
    "pipeline.model.sh_decay": 1.2,
    "pipeline.model.densify.least_views": 2,
    "pipeline.model.densify.least_views_every": 6,
}


@pytest.fixture(autouse=True)
def tiny_photos(monkeypatch):
    monkeypatch.setattr(pyramid, "LEAST_SIDE", 4)  # the photos of these runs are tiny


@pytest.fixture
def data(short_run):
    return short_run / "data"


def test_a_base_of_all_means_is_resumed_bit_for_bit(data, tmp_path, monkeypatch):
    from beags_plugin.plugin.model import BeagsModel

    sizes, outputs = [], BeagsModel._training_outputs

    def seen(self, cameras):
        sizes.append((self.step, cameras.metadata["camera"].width, int(cameras.width)))
        found = outputs(self, cameras)
        assert found["rgb"].shape[1] == sizes[-1][1]
        return found

    whole, killed = tmp_path / "whole", tmp_path / "killed"
    with monkeypatch.context() as patch:
        patch.setattr(BeagsModel, "_training_outputs", seen)
        run_to_end(usual_config(data, whole, **SHORT))
    own, cameras = zip(*((a, b) for _, a, b in sizes), strict=True)
    assert own == cameras and list(own) == sorted(own) and len(set(own)) == 4
    last = max(step for step, width, _ in sizes if width < own[-1])
    assert last == 0.8 * STEPS[0] - 1, last  # and refinement sees whole photos
    interrupted(data, killed, monkeypatch, lambda patch: kill_at(patch, 17), **SHORT)
    for step in (33, 44):
        with monkeypatch.context() as patch:
            kill_at(patch, step)
            with pytest.raises(Killed):
                resume_to_end(killed)
    resume_to_end(killed)
    assert_same_run(killed, whole)


@pytest.mark.parametrize("stop", [31, 11])  # the scene still grows then, or no more
def test_what_too_few_views_show_goes_but_for_what_is_hidden(data, tmp_path, monkeypatch, stop):
    """Before the pruning some Gaussians are moved behind all cameras, which go, and some are hidden, which stay."""
    calls, showing_views = [], densifier.showing_views

    def moved(model, datamanager, step):
        means = model.gauss_params["means"].data
        means[::4] = 1e4
        means[1::4] = means[2]
        model.gauss_params["scales"].data[1::4] = -20.0  # they cover no pixel
        calls.append((*showing_views(model, datamanager, step), len(datamanager.train_dataset)))
        return calls[-1][:2]

    monkeypatch.setattr(densifier, "showing_views", moved)
    options = {"pipeline.model.densify.least_views": 2, "pipeline.model.densify.least_views_every": 30,
               "pipeline.model.densify.stop": stop, "pipeline.model.densify.start": 10,
               "pipeline.model.refine_steps": 0}  # fmt: skip
    run_to_end(usual_config(data, tmp_path / "run", **options))
    ((showing, framing, views),) = calls
    assert (framing[::4] == 0).all() and (showing[::4] == 0).all() and int(framing.max()) <= views
    assert (showing[1::4] < 2).all() and (framing[1::4] > 2).all()
    stays = (showing >= 2) | (framing > 2)
    means = checkpoint_of(tmp_path / "run")["pipeline"]["_model.gauss_params.means"]
    assert len(means) == int(stays.sum()) < len(showing) and means.abs().max() < 1e3
    assert torch.isfinite(means).all()


@pytest.mark.parametrize(("least", "enough"), [(1, True), (10, False)])
def test_few_views_say_nothing_about_what_they_show(data, tmp_path, monkeypatch, least, enough):
    """Views are counted where there are more than twice ``least_views``, and nowhere else, though pruning is due."""
    views, counted = [], []
    prune, showing_views = densifier.Densifier._prune_by_views, densifier.showing_views

    def due(own, step):
        views.append(len(own.datamanager.train_dataset))
        prune(own, step)

    monkeypatch.setattr(densifier.Densifier, "_prune_by_views", due)
    monkeypatch.setattr(densifier, "showing_views", lambda *of: counted.append(of) or showing_views(*of))
    option = "pipeline.model.densify.least_views"
    run_to_end(usual_config(data, tmp_path / "run", **{option: least, f"{option}_every": 6}))
    assert views and all((count > 2 * least) == enough for count in views)
    assert len(counted) == (len(views) if enough else 0)
