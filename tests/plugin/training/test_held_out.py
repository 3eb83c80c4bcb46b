"""The curve of held-out quality that a run keeps."""

from __future__ import annotations

import json

import pytest
import torch

pytest.importorskip("nerfstudio")

from beags_plugin.core.cameras import Camera
from beags_plugin.core.exposure import Exposures
from beags_plugin.core.schedule import PhaseSchedule
from beags_plugin.core.surfels import Surfels
from beags_plugin.losses.photometric import ssim
from beags_plugin.plugin.training.monitor import HeldOutCurve
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.rasterizers.interface import RasterSettings
from beags_plugin.rasterizers.rendering import surfel_inputs
from beags_plugin.views.views import View

CAMERA = Camera(torch.eye(4), torch.tensor([[30.0, 0, 12], [0, 30.0, 10], [0, 0, 1]]), 24, 20)


class Model:
    """Stand-in for a model, with what the curve asks of it."""

    def __init__(self, rasterizer):
        g = torch.Generator().manual_seed(2)
        self.scene = Surfels.of(
            means=torch.randn(9, 3, generator=g) * 0.5 + torch.tensor([0.0, 0.0, 4.0]),
            quats=torch.randn(9, 4, generator=g),
            log_scales=torch.full((9, 2), -1.0),
            opacity_logits=torch.ones(9),
            sh=torch.randn(9, 4, 3, generator=g),
        )
        self.rasterizer, self.num_points, self.device = rasterizer, 9, torch.device("cpu")
        self.schedule = PhaseSchedule(base_steps=25, refine_steps=5)
        self.background_color = torch.zeros(3)
        self.exposures = None

    def surfels(self):
        return self.scene

    def active_sh_degree(self):
        return 1

    def settings(self, geometry):
        assert not geometry  # colours alone are cheap
        return RasterSettings(0.01, 100.0, geometry)


class Data:
    """Three training views and two held-out ones, plain grey."""

    def views(self, split):
        greys = {"train": (0.1, 0.2, 0.3), "eval": (0.4, 0.6)}[split]
        return [View(CAMERA, "v", lambda g=grey: {"image": torch.full((20, 24, 3), g)}, lambda: None) for grey in greys]


def test_it_measures_all_held_out_views_at_the_given_steps_and_where_phases_end(tmp_path):
    model = Model(make_rasterizer("torch"))
    curve = HeldOutCurve(tmp_path, 10, 28, model, Data())
    for step in range(28):
        curve.after_step(step)
    records = json.loads((tmp_path / "held_out.json").read_text())
    assert [record["step"] for record in records] == [10, 20, 25, 28]
    color = model.rasterizer.rasterize(
        surfel_inputs(model.scene, CAMERA, 1), CAMERA, model.settings(False), torch.zeros(3)
    ).color.clamp(0, 1)

    def psnr(grey):
        return float(-10 * torch.log10((color - grey).square().mean()))

    last = records[-1]
    assert last["psnr"] == pytest.approx((psnr(0.4) + psnr(0.6)) / 2, rel=1e-5)
    assert last["train_psnr"] == pytest.approx((psnr(0.1) + psnr(0.2)) / 2, rel=1e-5)  # It has as many views as psnr.
    greys = [torch.full((20, 24, 3), grey) for grey in (0.4, 0.6)]
    assert last["ssim"] == pytest.approx(sum(float(ssim(color, grey)) for grey in greys) / 2, rel=1e-5)
    assert last["gaussians"] == 9 and "psnr_fit" not in last
    assert all(0 <= records[0][clock] <= last[clock] for clock in ("seconds", "cpu_seconds"))


def test_of_a_scene_with_exposures_psnr_after_the_colour_fit_stands_beside_the_plain_one(tmp_path):
    """Grey photos are fitted by one colour: nothing is left but what rounding leaves."""
    model = Model(make_rasterizer("torch"))
    model.exposures = Exposures(("v",), torch.eye(3, 4)[None])
    curve = HeldOutCurve(tmp_path, 10, 28, model, Data())
    curve.after_step(9)
    (record,) = json.loads((tmp_path / "held_out.json").read_text())
    assert record["psnr"] < 30 and record["train_psnr"] < 30
    assert record["psnr_fit"] > 100 and record["train_psnr_fit"] > 100
