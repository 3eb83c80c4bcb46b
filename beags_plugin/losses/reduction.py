"""Sums and products whose order does not depend on the number of threads."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

_ROW = 1024  # torch splits the sum of a whole tensor between threads, but never a row of a sum over rows.
_BLOCK, _BLOCKS = 64, 64  # Rows of a small product, and the least number of products.


def ordered_sum(values: Tensor) -> Tensor:
    """Return the sum of all elements, bit for bit the same for any number of threads; differentiable.

    values: any shape, float. Returns a scalar of the same dtype.
    """
    values = values.reshape(-1)
    while values.numel() > _ROW:
        if missing := -values.numel() % _ROW:
            values = torch.nn.functional.pad(values, (0, missing))
        values = values.view(-1, _ROW).sum(1)
    return values.sum()  # These are too few elements to be split.


def ordered_mean(values: Tensor) -> Tensor:
    """Return the mean of all elements (0 of none), as ``ordered_sum``."""
    return ordered_sum(values) / max(values.numel(), 1)


def ordered_linear(rows: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """Return rows @ weight.T + bias, value and gradients bit for bit the same for any number of threads.

    rows: [..., C] float. weight: [K, C]. bias: [K]. Returns [..., K].
    """
    flat = torch.nn.functional.pad(rows.reshape(-1, rows.shape[-1]), (0, 1), value=1.0)
    product: Tensor = _RowProduct.apply(flat, torch.cat([weight, bias[:, None]], dim=1))  # pyright: ignore[reportAssignmentType]
    return product.view(*rows.shape[:-1], len(weight))


def ordered_outer_sum(first: Tensor, second: Tensor) -> Tensor:
    """Return first.T @ second, bit for bit the same for any number of threads; no gradient of its own.

    first: [P, A] float. second: [P, B]. Returns [A, B].
    """
    parts = torch.bmm(_blocks(first).transpose(1, 2), _blocks(second))
    sums = parts.flatten(1).T.contiguous().sum(dim=1)  # Each entry is a row, and no row is split.
    return sums.view(first.shape[1], second.shape[1])


class _RowProduct(torch.autograd.Function):
    """rows @ matrix.T as many small products. One thread computes each; torch would split a large product."""

    @staticmethod
    def forward(ctx: Any, rows: Tensor, matrix: Tensor) -> Tensor:
        ctx.save_for_backward(rows, matrix)
        return _times(rows, matrix.T)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, Tensor | None]:  # pyright: ignore[reportIncompatibleMethodOverride]
        rows, matrix = ctx.saved_tensors
        needs_rows, needs_matrix = ctx.needs_input_grad
        return _times(grad, matrix) if needs_rows else None, ordered_outer_sum(grad, rows) if needs_matrix else None


def _times(rows: Tensor, matrix: Tensor) -> Tensor:
    """Return [P, B] of [P, A] and [A, B]."""
    blocks = _blocks(rows)
    return torch.bmm(blocks, matrix.expand(len(blocks), -1, -1)).flatten(0, 1)[: len(rows)]


def _blocks(rows: Tensor) -> Tensor:
    """Return [P, A] as [blocks, 64, A], filled up with zeros; there are more blocks than threads."""
    if missing := max(-len(rows) % _BLOCK, _BLOCK * _BLOCKS - len(rows)):
        rows = torch.nn.functional.pad(rows, (0, 0, 0, missing))
    return rows.reshape(-1, _BLOCK, rows.shape[1])
