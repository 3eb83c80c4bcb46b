"""Options that no stage could work with are refused before the first step, in one sentence."""

from __future__ import annotations

import math
from types import SimpleNamespace

import pytest

from beags_plugin.losses.occupancy import OccupancyLoss
from beags_plugin.losses.photometric import PhotometricLoss
from beags_plugin.masks import REPROJECTIONS
from beags_plugin.options.stages import PreparationConfig
from beags_plugin.preparation.pipeline import check_options
from beags_plugin.system.errors import UserError


@pytest.mark.parametrize("reprojection", ["auto", "none", "pairwise", "voxel"])
@pytest.mark.parametrize("tau", [0.0, math.inf])
def test_options_at_their_limits_are_taken(reprojection, tau):
    check_options(PreparationConfig(reprojection=reprojection, tau=tau, depth="expected", k=1))  # raises nothing


def test_a_reprojection_of_another_package_that_does_not_load(monkeypatch):
    monkeypatch.setitem(REPROJECTIONS._specs, "theirs", "no_such_package:reproject")
    with pytest.raises(UserError, match="'theirs' .*cannot be loaded"):
        check_options(PreparationConfig(reprojection="theirs"))


@pytest.mark.parametrize(
    ("kind", "name", "value", "limits"),
    [
        *((OccupancyLoss, "samples", samples, "be a whole number, 1 or more") for samples in (0, -3, 2.5, math.nan)),
        *((PhotometricLoss, "ssim_weight", weight, "lie in 0..1") for weight in (-0.1, 1.5, math.nan)),
    ],
)
def test_wrong_options_of_a_loss(kind, name, value, limits):
    with pytest.raises(UserError, match=f"{name} = {value}: it must {limits}"):
        kind(**{name: value})


@pytest.mark.parametrize("refine_steps", [0, 10])
def test_a_run_is_refused_at_its_start_only_if_it_refines(refine_steps):
    pytest.importorskip("nerfstudio")
    from beags_plugin.plugin.options.config import base_config
    from beags_plugin.plugin.training.refinement import RefinementSwitch

    config = base_config().model_config
    config.refine_steps, config.prepare = refine_steps, PreparationConfig(k=0)
    switch = RefinementSwitch(SimpleNamespace(config=config), None, None)
    if refine_steps:
        with pytest.raises(UserError, match="k is 0"):
            switch.check()
    else:
        switch.check()
