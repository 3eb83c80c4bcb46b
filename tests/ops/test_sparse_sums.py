"""Sums of the keys that occur: those of a dense table bit for bit, compiled and in torch."""

from __future__ import annotations

import pytest
import torch

from beags_plugin.assignment.sparse_sums import TorchSparseSums, largest_in_rows
from beags_plugin.ops import extension
from beags_plugin.ops.sparse_sums import SparseSums

compiled = pytest.param(SparseSums, marks=pytest.mark.skipif(extension.load() is None, reason="nothing compiled"))
ways = pytest.mark.parametrize("way", [TorchSparseSums, compiled])
ROWS, COLUMNS = 40, 30


@ways
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_they_are_a_dense_table_bit_for_bit(way, dtype):
    generator = torch.Generator().manual_seed(0)
    dense, sparse = torch.zeros(ROWS * COLUMNS, dtype=torch.float64), way()
    for _ in range(12):
        chosen = torch.rand(ROWS * COLUMNS, generator=generator) < 0.05
        values = torch.rand(ROWS * COLUMNS, generator=generator, dtype=dtype)
        values = values * 10.0 ** torch.randint(-6, 3, (1,), generator=generator)
        dense += torch.where(chosen, values, 0.0).double()
        sparse.add(chosen.nonzero()[:, 0], values[chosen])
    keys, sums = sparse.totals()
    assert keys.tolist() == dense.nonzero()[:, 0].tolist() and torch.equal(sums, dense[keys])
    table = dense.view(ROWS, COLUMNS)
    first, top, everything = largest_in_rows(keys, sums, ROWS, COLUMNS)
    assert torch.equal(first, table.argmax(1)) and torch.equal(top, table.max(1).values)
    torch.testing.assert_close(everything, table.sum(1), rtol=1e-15, atol=0)


@ways
def test_nothing_and_equals(way):
    sums = way()
    sums.add(torch.zeros(0, dtype=torch.int64), torch.zeros(0))
    assert [value.tolist() for value in largest_in_rows(*sums.totals(), 2, 3)] == [[0, 0], [0.0, 0.0], [0.0, 0.0]]
    sums.add(torch.tensor([4, 5]), torch.tensor([2.0, 2.0]))
    sums.add(torch.zeros(0, dtype=torch.int64), torch.zeros(0))
    assert [value.tolist() for value in largest_in_rows(*sums.totals(), 2, 3)] == [[0, 1], [0.0, 2.0], [0.0, 4.0]]


def test_wrong_tensors_are_refused():
    if extension.load() is None:
        pytest.skip("nothing compiled")
    with pytest.raises(ValueError, match="keys must be"):
        SparseSums().add(torch.zeros(1), torch.zeros(1))
    with pytest.raises(ValueError, match="values must be"):
        SparseSums().add(torch.zeros(1, dtype=torch.int64), torch.zeros(2))
