"""Checkpoints are checked for what a scene needs."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from beags_plugin.system.errors import UserError

pytest.importorskip("nerfstudio")

from beags_plugin.plugin.runs.checkpoint_file import validate


def state(**changed) -> dict:
    shapes = {"means": (2, 3), "quats": (2, 4), "scales": (2, 2), "opacities": (2, 1), "features_dc": (2, 3)}
    made = {f"gauss_params.{name}": torch.ones(shape) for name, shape in shapes.items()}
    made["gauss_params.features_rest"] = torch.zeros(2, 3, 3)
    made |= {"class_ids": torch.zeros(2, dtype=torch.int32), "class_margin": torch.ones(2)}
    made |= {"assigned": torch.tensor(True), "extent": torch.tensor(1.0)}
    made["_extra_state"] = {"classes": {0: "background"}}
    return {**made, **{name.replace("__", "."): value for name, value in changed.items()}}


def test_a_whole_scene_passes():
    validate(state(), Path("a.ckpt"))


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"gauss_params__means": torch.ones(2, 3, dtype=torch.complex64)}, "means holds torch.complex64"),
        ({"gauss_params__features_rest": torch.zeros(2, 3, 3, dtype=torch.int32)}, "features_rest holds torch.int32"),
        ({"gauss_params__features_rest": torch.zeros(2, 4, 3)}, "4 colour bands"),
        ({"gauss_params__quats": torch.ones(3, 4)}, r"quats is \[3, 4\], not \[2, 4\]"),
        ({"gauss_params__scales": None}, "scales is missing"),
        ({"extent": torch.tensor(1 + 2j)}, "extent holds torch.complex64"),
        ({"class_margin": torch.ones(2, dtype=torch.complex64)}, "class_margin holds"),
        ({"class_ids": torch.zeros(2, dtype=torch.complex64)}, "class_ids holds torch.complex64"),
        ({"class_ids": torch.tensor([0, 4], dtype=torch.int32)}, "the class 4, which has no name"),
        ({"_extra_state": {"classes": ["cup"]}}, "names of its classes are missing"),
    ],
)
def test_a_damaged_one_is_refused(changed, words):
    with pytest.raises(UserError, match=f"a.ckpt holds no scene of beags .*{words}"):
        validate(state(**changed), Path("a.ckpt"))
