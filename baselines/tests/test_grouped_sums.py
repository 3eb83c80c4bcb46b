"""Sums of rows by groups against a product with a one-hot matrix."""

import torch

from beags_baselines.grouped_sums import grouped_sums


def test_sums_of_groups():
    values = torch.rand(1_250, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    groups = torch.arange(1_250) % 7
    one_hot = torch.nn.functional.one_hot(groups, 9).to(values)
    torch.testing.assert_close(grouped_sums(values, groups, 9), one_hot.T @ values)  # two groups without rows
    assert torch.autograd.gradcheck(lambda x: grouped_sums(x**2, groups, 9), values.requires_grad_(), fast_mode=True)
    assert grouped_sums(torch.zeros(0, 2), groups[:0], 3).tolist() == [[0.0, 0.0]] * 3
