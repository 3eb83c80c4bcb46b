"""ObjectGS's labels: by weight with and without the background, and by projected centres."""

from __future__ import annotations

import torch
from drawn_discs import camera, discs

from beags_baselines.objectgs import labels_by_majority, labels_by_weight
from beags_plugin.labels.class_ids import IGNORE


def test_by_weight():
    table = torch.tensor([[19.0, 1.0, 0.0], [5.0, 2.0, 2.0], [1.0, 0.0, 3.0], [4.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    keys = table.flatten().nonzero()[:, 0]
    sums = table.flatten()[keys].double()
    assert labels_by_weight(keys, sums, 5, 3).tolist() == [0, 0, 2, 0, 0]
    assert labels_by_weight(keys, sums, 5, 3, nonzero=True).tolist() == [1, 1, 2, 0, 0]  # one of twenty is enough


def test_by_majority_of_projected_centres():
    """Pixels 0..7 in a row; a mask of each view says which class lies there."""
    view, row = camera(8), [4.5]
    centers = [(x + 0.5, *row) for x in (1, 2, 5, 6, 3)] + [(-3.0, *row), (1.5, *row), (1.5, *row)]
    depths = [1.0] * 6 + [5.0, -1.0]  # the last but one is hidden straight behind the first; the last behind the camera
    points = discs(8, centers, 1.0, 0.5, depths).means

    def mask(*ids: int) -> torch.Tensor:
        return torch.tensor(ids, dtype=torch.int32).repeat(8, 1)

    i = IGNORE
    masks = [mask(0, 1, 0, 2, 0, 2, i, 0), mask(0, 1, 1, 0, 0, 1, i, 0), None, mask(0, 0, 0, 1, 0, 1, i, 0)]
    found = labels_by_majority(points, [view] * 4, masks, 3)
    # 1,1,0 | 0,1,0 | 2,1,1 | unlabelled | a tie of three | out of the picture | hidden, yet as the first | behind
    assert found.tolist() == [1, 0, 1, 0, 0, 0, 1, 0]
    assert found.dtype == torch.int32
