"""Checkpoints are checked for what a scene needs."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from beags_plugin.system.errors import UserError

pytest.importorskip("nerfstudio")

from beags_plugin.core.exposure import Exposures
from beags_plugin.core.membership import Membership
from beags_plugin.runs.checkpoint_file import exposures_of, extra_state, validate


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


def test_exposures_pass_and_are_read_as_they_were():
    exposures = Exposures(("a", "b"), torch.rand(2, 3, 4))
    members = Membership(torch.zeros(2, dtype=torch.int32))
    extra = extra_state({0: "background"}, members, exposures)
    validate(state(_extra_state=extra), Path("a.ckpt"))
    found = exposures_of(extra)
    assert found is not None and found.names == ("a", "b") and torch.equal(found.affine, exposures.affine)
    exposures.affine.zero_()  # Training goes on.
    assert found.affine.any()
    assert exposures_of({"classes": {}}) is None and "exposures" not in extra_state({}, members)


@pytest.mark.parametrize(
    "damaged",
    [
        3,
        {},
        {"names": ["a"]},
        {"names": "a", "affine": torch.zeros(1, 3, 4)},
        {"names": [1], "affine": torch.zeros(1, 3, 4)},
        {"names": ["a", "b"], "affine": torch.zeros(1, 3, 4)},
        {"names": ["a"], "affine": torch.zeros(1, 3, 3)},
        {"names": ["a"], "affine": torch.zeros(1, 3, 4, dtype=torch.int32)},
        {"names": ["a"], "affine": torch.full((1, 3, 4), torch.inf)},
    ],
)
def test_damaged_exposures_are_refused(damaged):
    extra = {"classes": {0: "background"}, "exposures": damaged}
    with pytest.raises(UserError, match=r"a.ckpt holds no scene of beags \(the exposures of its photos are damaged\)"):
        validate(state(_extra_state=extra), Path("a.ckpt"))


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
