"""Trace3D's rules on counts made by hand: what is ambiguous, whose Gaussians are, and when what happens."""

from __future__ import annotations

import pytest
import torch

from beags_baselines import instance_tracing as tracing
from beags_baselines.instance_tracing import (
    InstanceTracing,
    cycle_steps,
    members,
    never_composited,
    position_rate,
)
from beags_plugin.system.errors import UserError

VIEWS = {  # pixels of the two classes in each of five views; views that see it, that find it ambiguous; is it split?
    "A": ([(100, 0)] * 5, 5, 0, False),
    "B": ([(70, 30)] * 3 + [(90, 10)] * 2, 5, 3, True),
    "C": ([(12, 12)] * 5, 0, 0, False),
    "D": ([(70, 30)] * 2 + [(90, 10)] * 3, 5, 2, False),
    "E": ([(70, 30), (0, 90)] + [(0, 0)] * 3, 2, 1, True),
    "one pixel more than C": ([(13, 13)] * 5, 5, 5, True),
    "exactly 25 pixels": ([(13, 12)] * 5, 0, 0, False),
    "exactly 80 %": ([(80, 20)] * 5, 5, 0, False),
    "never": ([(0, 0)] * 5, 0, 0, False),
}


@pytest.mark.parametrize("columns", [2, 1_000_000])
def test_ambiguous_in_too_many_of_the_views_that_see_it(columns):
    """The result is the same with class ids far apart, because only pairs that occur are given."""
    traced = InstanceTracing(len(VIEWS))
    for view in range(5):
        table = torch.tensor([views[view] for views, *_ in VIEWS.values()])
        row, column = table.nonzero(as_tuple=True)
        traced.add(row * columns + column * (columns - 1), table[row, column].int(), columns)
    found = zip(traced.seen.tolist(), traced.ambiguous_in.tolist(), traced.ambiguous().tolist(), strict=True)
    assert dict(zip(VIEWS, found, strict=True)) == {name: tuple(expected) for name, (_, *expected) in VIEWS.items()}
    assert traced.seen.dtype == traced.ambiguous_in.dtype == torch.int32


def test_options_of_the_tracing():
    """Weights instead of counts hide what lies behind; corners of three classes are ambiguous."""
    traced = InstanceTracing(3)
    keys = torch.tensor([0, 3, 6, 7, 8])
    traced.add(keys, torch.tensor([27.0, 2.7, 40.0, 30.0, 30.0]), 3)
    assert (traced.seen.tolist(), traced.ambiguous().tolist()) == ([1, 0, 1], [False, False, True])
    traced = InstanceTracing(3)
    traced.add(keys, torch.tensor([27.0, 2.7, 40.0, 30.0, 30.0]), 3, min_pixels=2, min_share=0.3)
    assert (traced.seen.tolist(), traced.ambiguous().tolist()) == ([1, 1, 1], [False] * 3)
    traced.seen[:], traced.ambiguous_in[:] = 100, torch.tensor([40, 41, 39])
    assert traced.ambiguous().tolist() == [False, True, False]


def test_members_hold_more_than_two_thirds_of_their_pixels():
    totals = torch.tensor([(67, 33, 0), (66, 34, 0), (50, 30, 20), (0, 0, 0), (1, 2, 97)], dtype=torch.int32)
    found = [members(totals[:, c], totals.sum(1)).nonzero()[:, 0].tolist() for c in range(3)]
    assert found == [[0], [], [4]]


def test_what_no_view_composites():
    views = [torch.tensor([0, 3]), torch.tensor([], dtype=torch.int64), torch.tensor([3, 1])]
    assert never_composited(views, 5).tolist() == [False, False, True, False, True]


@pytest.mark.parametrize(
    "steps, cycles",
    [
        (9_000, [10, 1_210, 2_410, 3_610]),
        (900, [1, 121, 241, 361]),
        (27_000, [30, 3_630, 7_230, 10_830]),
        (10, [1, 2, 3, 4]),
        (3, [1, 2]),
    ],
)
def test_cycles_move_with_the_number_of_steps(steps, cycles):
    assert cycle_steps(steps) == cycles


def test_rates_of_the_positions():
    assert [position_rate(step, 5.0) for step in (1, 9_000)] == [0.0, 0.0]
    intended = [position_rate(step, 1.0, schedule="intended") for step in (0, 1_500, 9_000, 30_000)]
    assert intended == pytest.approx([1.6e-4, 1.6e-4 * 10**-0.1, 4.02e-5, 1.6e-6], rel=1e-3)
    assert position_rate(90, 2.5, steps=90, schedule="intended") == pytest.approx(2.5 * intended[2])
    with pytest.raises(UserError, match="released, intended"):
        position_rate(1, 1.0, schedule="other")  # pyright: ignore[reportArgumentType]


def test_defaults_are_the_sources():
    defaults = tracing.MIN_PIXELS, tracing.MIN_SHARE, tracing.MAX_AMBIGUOUS, tracing.MEMBER_SHARE, tracing.STEPS
    assert defaults == (25, 0.8, 0.4, 0.66, 9_000)
