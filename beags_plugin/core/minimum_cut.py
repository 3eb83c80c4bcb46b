"""The minimum cut of a graph whose nodes are linked to one another and to two terminals."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

FIXED_POINT = 2**16  # scipy's flows are int32, so capacities must stay below 32,768


def cut(pairs: Tensor, capacities: Tensor, terminals: Tensor) -> Tensor:
    """Return the object's side of the minimum cut, [N] bool: all nodes that cannot reach the sink, so ties too.

    pairs: [P, 2] int64. capacities: [P] float64, of a link in both directions. terminals: [N, 2] float64, from the
    source (object) and to the sink (rest).
    """
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import breadth_first_order, maximum_flow

    count = len(terminals)
    source, sink = count, count + 1
    first, second = pairs.numpy().T
    nodes, links = np.arange(count), _fixed_point(capacities)
    gain = _fixed_point(terminals[:, 0]) - _fixed_point(terminals[:, 1])  # a capacity common to both changes no cut
    rows = np.concatenate([first, second, np.full(count, source), nodes])
    columns = np.concatenate([second, first, nodes, np.full(count, sink)])
    values = np.concatenate([links, links, gain.clip(0), (-gain).clip(0)])
    positive = values > 0
    shape = (count + 2, count + 2)
    graph = csr_array((values[positive], (rows[positive], columns[positive])), shape=shape, dtype=np.int32)
    residual = graph - maximum_flow(graph, source, sink, method="dinic").flow  # scipy stores no zeros of a difference
    reaching = breadth_first_order(residual.T, sink, return_predecessors=False)
    inside = np.ones(count + 2, dtype=bool)
    inside[reaching] = False
    return torch.from_numpy(inside[:count])


def _fixed_point(capacities: Tensor) -> np.ndarray:
    return (capacities * FIXED_POINT).round().int().numpy()
