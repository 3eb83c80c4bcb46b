"""In a training, the host knows the objects of each mask and the Gaussians of each class, also after they change."""

from __future__ import annotations

import pytest
import torch

pytest.importorskip("nerfstudio")

from resumed_runs import STEPS, run_to_end, short_config

from beags_plugin.labels.class_ids import objects_in
from beags_plugin.losses.silhouette import SilhouetteLoss


def test_members_and_objects_are_those_of_every_step(short_run, tmp_path, monkeypatch):
    value, seen = SilhouetteLoss.value, []

    def checked(self, inputs):
        for class_id in inputs.class_ids.unique().tolist():
            assert torch.equal(inputs.members.of(class_id), (inputs.class_ids == class_id).nonzero()[:, 0])
        assert inputs.present == objects_in(inputs.labels) and inputs.present
        seen.append(inputs.members)
        return value(self, inputs)

    monkeypatch.setattr(SilhouetteLoss, "value", checked)
    config = short_config(short_run / "data", tmp_path / "run", **{"pipeline.model.losses.silhouette.weight": 0.5})
    run_to_end(config)
    assert len(seen) == STEPS[1]
    assert len({id(members) for members in seen}) == 1  # looked at once
