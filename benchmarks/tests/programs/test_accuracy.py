"""The comparison of rasterizers with the reference in float64."""

from __future__ import annotations

import json

import pytest
import torch

from beags_benchmarks.kernels import accuracy
from beags_benchmarks.kernels.scenes import make_scene, parse_size
from beags_plugin.rasterizers import native
from beags_plugin.system.errors import UserError

SMALL = "300/64x48"
ERRORS = ("color_error", "image_error", "gradient_error")


@pytest.fixture
def one_thread():
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)


def test_an_error_is_relative_to_the_true_norm():
    true = {"a": torch.tensor([3.0, 4.0], dtype=torch.float64), "b": torch.ones(4, dtype=torch.float64)}
    found = {"a": torch.tensor([3.0, 4.5]), "b": torch.ones(4)}
    assert accuracy.errors(found, true) == {"a": pytest.approx(0.1), "b": 0.0}


def test_every_float_of_a_scene_changes_its_dtype_and_no_class_does():
    scene = accuracy.in_dtype(make_scene(parse_size(SMALL)), torch.float64)
    floats = [scene.colors, scene.background, scene.surfels.means, scene.surfels.sh_rest, *scene.gradients.values()]
    assert {value.dtype for value in floats} == {torch.float64}
    assert scene.class_ids.dtype == scene.target.dtype == torch.int32


@pytest.mark.skipif(bool(native.NativeRasterizer.unavailable()), reason="needs the compiled rasterizer")
def test_float64_agrees_and_float32_is_within_its_rounding(tmp_path, capsys, one_thread):
    target = tmp_path / "rasterizers.json"
    accuracy.main(["--size", SMALL, "--seeds", "2", "--calls", "1", "--json", str(target)])
    result = json.loads(target.read_text())
    assert [row["seed"] for row in result["rows"]] == [0, 0, 0, 1, 1, 1]
    rows = {row["variant"]: row for row in result["rows"] if row["seed"] == 0}
    assert list(rows) == ["native, float32", "torch, float32", "native, float64"]
    assert all(rows["native, float64"][name] < 1e-9 for name in ERRORS)
    for name in ("native, float32", "torch, float32"):
        assert 1e-8 < rows[name]["color_error"] < 1e-4 and rows[name]["image_error"] >= rows[name]["color_error"]
    assert all(row["cpu_ms"] > 0 and row["scene"] == SMALL for row in rows.values())
    assert result["machine"]["cpu"] and "worst gradient" in capsys.readouterr().out


@pytest.mark.parametrize("option", ["--seeds", "--calls"])
def test_nothing_to_measure_is_refused(option):
    with pytest.raises(UserError, match="at least one scene and one call"):
        accuracy.main([option, "0"])
