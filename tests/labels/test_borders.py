"""Pixels at the borders of classes, against a slow count."""

from __future__ import annotations

import torch

from beags_plugin.labels.borders import at_border
from beags_plugin.labels.class_ids import IGNORE


def test_pixels_next_to_another_class():
    generator = torch.Generator().manual_seed(0)
    labels = torch.randint(0, 3, (9, 11), generator=generator, dtype=torch.int32)
    labels[:4, :6] = 1  # some pixels lie at no border
    labels[torch.rand(9, 11, generator=generator) < 0.2] = IGNORE
    found = at_border(labels)
    for y in range(9):
        for x in range(11):
            near = labels[max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2].flatten().tolist()
            assert found[y, x] == (labels[y, x] != IGNORE and len(set(near) - {IGNORE}) > 1)
    assert 10 < int(found.sum()) < 90
