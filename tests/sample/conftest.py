"""The scene that tests of the sample share."""

from __future__ import annotations

import pytest

from beags_plugin.sample.arrangement import make_still
from beags_plugin.sample.lighting import Light
from beags_plugin.sample.views import make_views, render_view


@pytest.fixture(scope="session")
def scene():
    """(still, views, pictures) of twelve views."""
    still = make_still(0)
    light = Light(still, object_samples=2, ground_samples=6)
    views = make_views(0, 96, 72, 10, 2)
    return still, views, [render_view(still, light, view, 1) for view in views]
