"""The scenes that tests of the sample share."""

from __future__ import annotations

import pytest

from beags_plugin.sample import FAMILIES
from beags_plugin.sample.views import render_view


@pytest.fixture(scope="session", params=("tabletop", "desk"))
def lit_scene(request):
    """(scene, light, views, pictures) of twelve views, of each family of the product."""
    family = FAMILIES.get(request.param)
    made = family.scene(0)
    light = family.light(made)
    views = family.views(0, 96, 72, 10, 2)
    return made, light, views, [render_view(made, light, view, 1) for view in views]


@pytest.fixture(scope="session")
def scene(lit_scene):
    """(scene, views, pictures)."""
    made, _, views, pictures = lit_scene
    return made, views, pictures
