"""The fuzz script: scenes are always the same, what it asks holds for some of them, and it notices what is wrong."""

from __future__ import annotations

import pytest
import torch

from beags_plugin.ops import extension

fuzz = pytest.importorskip("fuzz")


def test_a_scene_is_decided_by_its_number():
    first, again, other = (fuzz.degenerate_scene(number) for number in (17, 17, 18))
    for name in fuzz.FLOATS:
        one, two = getattr(first.inputs, name), getattr(again.inputs, name)
        assert torch.equal(one.nan_to_num(nan=0.5), two.nan_to_num(nan=0.5))
    assert torch.equal(first.camera.viewmat, again.camera.viewmat)
    assert not torch.equal(first.camera.viewmat, other.camera.viewmat)
    ways = {way for number in range(300) for ways in fuzz.degenerate_scene(number).spoilt for way in ways.split("+")}
    assert ways == {
        "", "edge-on", "crossing", "behind", "at the camera", "size", "opacity", "quaternion", "coincident", "far",
        "broken",
    }  # fmt: skip


@pytest.mark.skipif(extension.load() is None, reason="the compiled extension is not built")
def test_nothing_is_wrong_with_some_scenes():
    findings = [fuzz.examine(number) for number in range(20)]
    assert [finding.failures for finding in findings if finding.failures] == []
    assert sum(bool(finding.unclear) for finding in findings) <= 4


@pytest.mark.skipif(extension.load() is None, reason="the compiled extension is not built")
def test_wrong_results_are_noticed(monkeypatch):
    right, number = fuzz.everything, 21
    assert not fuzz.examine(number).failures

    def wrong(change):
        def everything(rasterizer, scene):
            results = right(rasterizer, scene)
            return change(results) if type(rasterizer).__name__ == "NativeRasterizer" else results

        monkeypatch.setattr(fuzz, "everything", everything)
        return "; ".join(fuzz.examine(number).failures)

    assert "color differs by" in wrong(lambda results: {**results, "color": results["color"] + 1e-3})
    assert "alpha is not finite" in wrong(lambda results: {**results, "alpha": results["alpha"] * torch.nan})
