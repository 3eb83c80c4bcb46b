"""Growth where close-ups look: which Gaussians count as near, and how many of them may grow."""

from __future__ import annotations

import math

import pytest
import torch

pytest.importorskip("nerfstudio")

from random_surfels import random_surfels

from beags_plugin.core.cameras import Camera
from beags_plugin.core.densification import densify
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.options.stages import DensifyConfig
from beags_plugin.plugin.training.near_growth import MORE, PHOTOS, MaskedPhotos, on_objects, shared_pixels
from beags_plugin.views.views import View


def test_centres_are_looked_up_in_the_pixel_that_shows_them():
    camera = Camera(torch.eye(4), torch.tensor([[10.0, 0, 4], [0, 10.0, 3], [0, 0, 1]]), 8, 6)
    labels = torch.zeros(6, 8, dtype=torch.int32)
    labels[2, 5], labels[2, 6], labels[0, 0] = 3, IGNORE, 3
    places = [(5.5, 2.5, 2.0), (6.5, 2.5, 2.0), (4.5, 2.5, 2.0), (5.5, 2.5, -2.0), (-0.5, -0.5, 2.0), (5.0, 2.0, 9.0)]
    means = torch.tensor([[(x - 4) / 10 * z, (y - 3) / 10 * z, z] for x, y, z in places])
    means = torch.cat([means, torch.tensor([[0.0, 0.0, 0.0], [math.nan, 0.0, 1.0]])])
    assert on_objects(means, camera, labels).tolist() == [True, False, False, False, False, True, False, False]


def test_nearly_all_photos_with_labels_there_decide():
    """A photo votes on the places that it shows, if it says what is there."""
    camera = Camera(torch.eye(4), torch.tensor([[10.0, 0, 4], [0, 10.0, 3], [0, 0, 1]]), 8, 6)
    means = torch.tensor([[0.1, 0.1, 2.0], [0.5, 0.1, 2.0], [9.0, 0.0, 2.0]])  # pixels (4, 3), (6, 3), none
    photos = []
    for number in range(10):
        labels = torch.zeros(6, 8, dtype=torch.int32)
        labels[3, 4], labels[3, 6] = 2, 2 if number < 8 else 0
        photos.append((camera, labels))
    unlabelled = (camera, torch.full((6, 8), IGNORE, dtype=torch.int32))
    assert MaskedPhotos(photos + 30 * [unlabelled]).near(means).tolist() == [True, False, False]


def test_photos_from_all_over_the_path_are_asked():
    views = [
        View(Camera(torch.eye(4), torch.eye(3), 1, 1), str(number), dict, lambda: torch.ones(1, 1))
        for number in range(200)
    ]
    assert len(MaskedPhotos.of(views, list(range(0, 200, 2))).photos) == PHOTOS
    assert len(MaskedPhotos.of(views, [3, 9]).photos) == 2


def test_each_part_grows_within_its_bound():
    surfels = random_surfels(10)
    near = torch.arange(10) < 4
    gradient = torch.linspace(1.0, 2.0, 10)

    def grown(most: int, most_near: int) -> tuple[int, int]:
        units = torch.full((10,), 1e9)  # all are small: they are cloned
        config = DensifyConfig(max_surfels=most, prune_scale_after=0)
        edited = densify(surfels, gradient, units, config, 1, torch.Generator(), (near, most_near))
        sources = near[edited.source]
        return int(sources.sum()), int((~sources).sum())

    assert grown(6, 4) == (4, 6) and grown(6, 7) == (7, 6) and grown(8, 4) == (4, 8)
    assert grown(0, 0) == (8, 12)  # no bound acts


def test_bounds_stay_near_those_without_close_ups():
    assert shared_pixels(1000, 100) == (100, 1000)
    near, far = shared_pixels(1000, 5000)
    assert near == far and near + far == pytest.approx(MORE * 1000)
