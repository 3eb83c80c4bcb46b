"""Labels of pixels as ranks of classes."""

from __future__ import annotations

from torch import Tensor

from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.labels.class_ranks import ClassRanks


def ranked_labels(class_ranks: ClassRanks, labels: Tensor) -> Tensor:
    """Return the ranks of labels of any shape; IGNORE where they are IGNORE or an unknown id."""
    ranks = class_ranks.ranks(labels)
    return ranks.masked_fill_(ranks == len(class_ranks), IGNORE)
