"""The part of a silhouette that rests on surface which photos show."""

from __future__ import annotations

import numpy as np
import torch

from beags_plugin.core.cameras import Camera
from beags_plugin.evaluation.metrics import mask_metrics
from beags_plugin.evaluation.records import EvalView
from beags_plugin.evaluation.truths import seen_truth
from beags_plugin.sample.seen import PATCH, seen_part, well_seen
from beags_plugin.sample.views import View


def looking_down() -> View:
    """Look straight down from z = 4, with 20 pixels to a world unit at z = 0."""
    pose = np.eye(4)
    pose[2, 3] = 4.0
    return View("v", "test", pose, 80.0, 20.0, 15.0, 40, 30)


def test_a_patch_counts_when_enough_photos_show_it():
    everywhere = np.array([[0.5, 0.5, 0.5]]) * PATCH
    once = everywhere + 10 * PATCH
    parts = [np.concatenate([everywhere, once]), everywhere, everywhere]
    assert well_seen(parts, min_views=3).tolist() == [everywhere[0].tolist()] * 3
    assert len(well_seen(parts, min_views=1)) == 4
    assert len(well_seen(parts, min_views=4)) == 0


def test_only_pixels_over_seen_surface_remain():
    x, y = np.meshgrid(np.linspace(-0.5, 0.0, 40), np.linspace(-0.3, 0.3, 40))
    surface = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    silhouette = np.zeros((30, 40), dtype=bool)
    silhouette[9:21, 10:30] = True  # x from -0.5 to 0.5
    seen = seen_part(looking_down(), surface, silhouette)
    assert seen[10:20, 10:20].all()
    assert not seen[:, 22:].any()
    assert not (seen & ~silhouette).any()


def test_unseen_pixels_are_left_out_and_make_no_boundary():
    silhouette = torch.zeros(60, 60, dtype=torch.bool)
    silhouette[10:50, 10:50] = True
    seen = silhouette.clone()
    seen[25:35, 25:35] = False
    camera = Camera(torch.eye(4), torch.eye(3), 60, 60)
    view = EvalView(camera, None, silhouettes={1: silhouette}, seen={1: seen})
    truth = seen_truth(view, 1)
    assert truth.source == "silhouette" and torch.equal(truth.unknown, silhouette & ~seen)
    assert mask_metrics(seen, truth.mask, truth.unknown).biou == 1.0  # a hole where nothing is known
    assert mask_metrics(seen, truth.mask).biou < 0.9  # the same hole counts where it is known
