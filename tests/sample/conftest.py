"""The scenes that tests of the sample share."""

from __future__ import annotations

import pytest

from beags_plugin.sample.families import FAMILIES
from beags_plugin.sample.views import render_view


@pytest.fixture(scope="session", params=("tabletop", "room"))
def scene(request):
    """(scene, views, pictures) of twelve views, of each family that has geometry of its own."""
    family = FAMILIES[request.param]
    made = family.scene(0)
    light = family.light(made)
    views = family.views(0, 96, 72, 10, 2)
    return made, views, [render_view(made, light, view, 1) for view in views]
