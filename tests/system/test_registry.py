"""Registries: lazy specs, entry points, and messages; every built-in loss can be made."""

from __future__ import annotations

import sys
from types import SimpleNamespace

import pytest

import beags_plugin.system.registry as registry_module
from beags_plugin.losses import LOSSES
from beags_plugin.losses.base import Loss
from beags_plugin.system.errors import UserError
from beags_plugin.system.registry import Registry


def _registry(**more: str) -> Registry:
    return Registry("thing", "beags.tests", {"ordered": "collections:OrderedDict", **more})


def test_listing_imports_nothing():
    sys.modules.pop("this", None)
    registry = _registry(zen="this:s")
    assert registry.names() == ["ordered", "zen"]
    assert "this" not in sys.modules


def test_get_imports_the_attribute():
    from collections import OrderedDict

    assert _registry().get("ordered") is OrderedDict


@pytest.mark.parametrize("spec", ["no_such_module:Thing", "collections:NoSuchThing"])
def test_a_spec_that_fails_is_named(spec):
    with pytest.raises(UserError, match=f"'broken' \\({spec}\\) cannot be loaded"):
        _registry(broken=spec).get("broken")


def test_an_unknown_name_lists_the_known_ones():
    with pytest.raises(UserError, match="no thing 'orderd' .did you mean ordered.*: choose one of a, ordered"):
        _registry(a="math:pi").get("orderd")


def test_the_message_says_where_more_come_from_until_a_package_adds_some(monkeypatch):
    points = []
    monkeypatch.setattr(registry_module, "entry_points", lambda group: points)

    def refusal() -> str:
        with pytest.raises(UserError) as refused:
            Registry("thing", "beags.tests", {"zen": "math:pi"}, "; more come with far").get("yoga")
        return str(refused.value)

    assert refusal() == "there is no thing 'yoga': choose one of zen; more come with far."
    points.append(SimpleNamespace(name="tao", value="math:tau"))
    assert refusal() == "there is no thing 'yoga': choose one of tao, zen."


def test_entry_points_are_found_once(monkeypatch):
    calls = []

    def entry_points(group):
        calls.append(group)
        return [SimpleNamespace(name="pi", value="math:pi")]

    monkeypatch.setattr(registry_module, "entry_points", entry_points)
    registry = _registry()
    assert registry.names() == ["ordered", "pi"] and registry.get("pi") == pytest.approx(3.14159265)
    assert calls == ["beags.tests"]


def test_a_name_is_given_once():
    registry = _registry()
    registry.register("ordered", "collections:OrderedDict")  # the same again does no harm
    with pytest.raises(UserError, match="two things are called 'ordered'"):
        registry.register("ordered", "math:pi")


def test_built_in_losses_and_their_defaults():
    defaults = {
        "photometric": (1.0, 0, set()),
        "normal": (0.05, 7000, {"geometry"}),
        "distortion": (0.0, 3000, {"distortion"}),
        "boundary": (0.5, 0, {"boundary"}),
        "occupancy": (10.0, 0, set()),
    }
    assert set(defaults) <= set(LOSSES.names())
    for name, (weight, start, needs) in defaults.items():
        loss = LOSSES.get(name)()
        assert isinstance(loss, Loss)
        assert (loss.weight, loss.start, loss.stop, set(loss.needs)) == (weight, start, None, needs)


def test_when_a_loss_is_active():
    loss = LOSSES.get("photometric")(weight=2.0, start=10, stop=20)
    assert [step for step in (9, 10, 19, 20) if loss.active(step)] == [10, 19]
    assert not LOSSES.get("photometric")(weight=0.0).active(5)
