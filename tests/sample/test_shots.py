"""Photos that are rendered beside each other, and which of them show a seed point."""

from __future__ import annotations

import numpy as np
import pytest
from sample_checks import assert_tracks_agree

from beags_plugin.sample import FAMILIES
from beags_plugin.sample.shots import AHEAD, taken
from beags_plugin.sample.views import render_view
from beags_plugin.sample.writer import SampleConfig


@pytest.mark.parametrize("family", ["tabletop", "desk"])
def test_tracks_agree_with_exact_geometry(family):
    assert_tracks_agree(SampleConfig(family=family))


@pytest.mark.parametrize("count", [1, AHEAD, AHEAD + 3])
def test_pictures_rendered_beside_each_other_are_those_of_one_after_another(count):
    made = FAMILIES.get("desk")
    shots = SampleConfig().shots(made, made.views(0, 32, 24, count, 1)[:count])
    pictures = list(taken(shots, 2))
    assert [shot for shot, _ in pictures] == shots
    for shot, picture in pictures:
        alone = render_view(shot.scene, shot.exposed, shot.view, 2)
        for name in ("image", "labels", "depth", "silhouettes"):
            assert np.array_equal(getattr(picture, name), getattr(alone, name))
