"""The command that refines with new masks: it can be pasted, and begins at a base."""

from __future__ import annotations

import shlex
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from beags_plugin.objects.picked_masks import refinement_command
from beags_plugin.views.data_options import DataOptions


@pytest.mark.parametrize("refined", [False, True])
def test_the_command_loads_the_base_of_a_refined_run_with_the_options_of_its_data(tmp_path, refined):
    """A refined run is complete: loaded itself, it is refused."""
    models = tmp_path / "my run/nerfstudio_models"
    for folder in [models, *([models.parent / "base/nerfstudio_models"] if refined else [])]:
        folder.mkdir(parents=True)
        (folder / "step-000000799.ckpt").touch()
    config = SimpleNamespace(data_config=SimpleNamespace(photos="all"), get_checkpoint_dir=lambda: models)
    parser = replace(DataOptions(), data=Path("/my data"), downscale_factor=1.6229166666666666)
    words = shlex.split(refinement_command(config, parser))  # type: ignore[arg-type]
    loaded = models.parent / "base/nerfstudio_models" if refined else models
    assert words == [
        "ns-train", "beags-refine", "--data", "/my data", "--load-dir", str(loaded),
        "beags-data", "--downscale-factor", "1.6229166666666666",
    ]  # fmt: skip
