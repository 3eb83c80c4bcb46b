"""GaussianCut: numbers worked by hand, every cut of small graphs, another solver, and what it keeps and swallows."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
import torch
from torch import Tensor

from beags_baselines import graph_cut
from beags_baselines.graph_cut import members, n_links, terminals
from beags_plugin.core.minimum_cut import cut


def on_a_line(*x: float) -> Tensor:
    return torch.tensor([[each, 0.0, 0.0] for each in x])


def energy(inside: Tensor, pairs: Tensor, capacities: Tensor, caps: Tensor) -> float:
    between = inside[pairs[:, 0]] != inside[pairs[:, 1]]
    return float(caps[inside, 1].sum() + caps[~inside, 0].sum() + capacities[between].sum())


def bits(count: int) -> Tensor:
    return torch.tensor(list(product([False, True], repeat=count)))


def random_scene(count: int, seed: int, size: float = 1.0) -> tuple[Tensor, Tensor, Tensor]:
    """Return centres, colour coefficients and shares, above the threshold for the first half."""
    g = torch.Generator().manual_seed(seed)
    shares = torch.rand(count, generator=g).double()
    shares = torch.where(torch.arange(count) < count // 2, 0.9 + 0.1 * shares, 0.9 * shares)
    return size * torch.randn(count, 3, generator=g), torch.randn(count, 3, generator=g), shares


HAND = {  # centres, shares; links, terminals, members, energy
    "two": ((0, 3), (0.95, 0), [1.049787], [(1.95, 0.920409), (0.870409, 2)], [False, False], 2.820409),
    "three": ((0, 0.1, 10), (1, 0.45, 0), [1.904837, 0.500025], None, [True, True, False], 3.728990),
}


@pytest.mark.parametrize("case", HAND)
def test_numbers_worked_by_hand(case):
    x, w, links, caps, inside, flow = HAND[case]
    means, shares = on_a_line(*x), torch.tensor(w, dtype=torch.float64)
    dark = torch.zeros_like(means)
    pairs, capacities = n_links(means, dark, num_edges=2)
    assert capacities.tolist() == pytest.approx(links, abs=1e-6)
    found = terminals(means, dark, shares, 0.9)
    assert caps is None or np.allclose(found, caps, atol=1e-6)
    assert cut(pairs, capacities, found).tolist() == inside
    assert members(means, dark, shares, (pairs, capacities), 0.9).tolist() == inside
    assert energy(torch.tensor(inside), pairs, capacities, found) == pytest.approx(flow, abs=1e-6)


def test_two_gaussians_stay_together_only_by_the_doubled_mutual_link():
    means = on_a_line(0, 3)
    pairs, capacities = n_links(means, means * 0, num_edges=2)
    caps = terminals(means, means * 0, torch.tensor([0.95, 0.0]))
    inside = torch.tensor([True, False])
    assert energy(inside, pairs, capacities, caps) == pytest.approx(2.840605, abs=1e-6)
    assert cut(pairs, capacities / 2, caps).tolist() == inside.tolist()
    assert energy(inside, pairs, capacities / 2, caps) == pytest.approx(2.315712, abs=1e-6)


def test_without_links_each_goes_where_its_terminals_pull():
    """Centres 1e6 apart, colours too: links are 0."""
    means, dc, shares = random_scene(40, seed=1)
    pairs, capacities = n_links(means * 1e6, dc * 1e6)
    assert capacities.max() < 1e-9
    caps = terminals(means * 1e6, dc * 1e6, torch.where(shares >= 0.9, 0.95, 0.3))
    expected = caps[:, 0] > caps[:, 1]
    assert torch.equal(cut(pairs, capacities, caps), expected) and 0 < expected.sum() < 40
    assert cut(pairs[:0], capacities[:0], torch.tensor([[1.0, 1.0], [0.5, 1.0]])).tolist() == [True, False]  # a tie


@pytest.mark.parametrize("seed", range(12))
def test_no_set_of_gaussians_has_less_energy(seed):
    """Five Gaussians a side, so that each is its own cluster; the energy is summed as the paper states it."""
    means, dc, w = random_scene(10, seed, size=(0.3, 1.0, 5.0)[seed % 3])
    apart = torch.cdist(means.double(), means.double())
    contrast = torch.cdist(dc.double(), dc.double())
    affinity = 0.5 * (-apart).exp() + 0.5 * (-contrast).exp()
    table = torch.zeros(10, 10, dtype=torch.float64)
    for i, j in product(range(10), range(10)):
        if i != j and j in apart[i].argsort()[:4]:
            table[i, j] += affinity[i, j]
            table[j, i] += affinity[i, j]
    cost = {}
    for name, own in (("object", slice(0, 5)), ("rest", slice(5, 10))):
        off_colour = (dc.double() - dc[own].double().mean(0)).norm(dim=1)
        cost[name] = 0.5 * (-0.1 * apart[:, own].amin(1)).exp() + 0.5 * (-off_colour).exp()

    def worked(inside: Tensor) -> float:
        paid = torch.where(inside, 1 - w + cost["rest"], w + cost["object"]).sum()
        return float(paid + table[inside][:, ~inside].sum())

    links = n_links(means, dc, num_edges=4)
    found = members(means, dc, w, links)
    assert energy(found, *links, terminals(means, dc, w)) == pytest.approx(worked(found), abs=1e-9)
    assert worked(found) <= min(worked(inside) for inside in bits(10)) + 1e-3  # capacities are multiples of 2^-16


@pytest.mark.parametrize("seed", range(3))
def test_another_solver_finds_the_same_cut(seed):
    """The capacities of the third seed are so coarse that cuts tie."""
    networkx = pytest.importorskip("networkx")
    means, dc, w = random_scene(150, seed)
    pairs, capacities = n_links(means, dc, num_edges=4)
    capacities, caps = capacities / 4, terminals(means, dc, w)
    if seed == 2:
        capacities, caps = (capacities * 8).ceil() / 8, (caps * 8).round() / 8
    graph = networkx.DiGraph()
    for (i, j), capacity in zip(pairs.tolist(), (capacities * 2**16).round().long().tolist(), strict=True):
        graph.add_edge(i, j, capacity=capacity)
        graph.add_edge(j, i, capacity=capacity)
    for i, (object_, rest) in enumerate((caps * 2**16).round().long().tolist()):
        graph.add_edge("source", i, capacity=object_)
        graph.add_edge(i, "sink", capacity=rest)
    from_source = networkx.minimum_cut(graph, "source", "sink")[1][0]  # all that cannot reach the sink
    found = cut(pairs, capacities, caps)
    assert set(found.nonzero()[:, 0].tolist()) == from_source - {"source"} and 0 < found.sum() < 150


def noisy(truth: Tensor, generator: torch.Generator) -> Tensor:
    return (truth + 0.3 * torch.randn(len(truth), generator=generator)).clamp(0, 1).double()


def test_a_sphere_on_a_plane_is_kept_and_a_ball_inside_a_cube_swallowed():
    g = torch.Generator().manual_seed(0)
    sphere = torch.nn.functional.normalize(torch.randn(1_000, 3, generator=g), dim=1)
    plane = torch.rand(4_000, 3, generator=g) * 8 - 4
    sphere[:, 2] += 1
    plane[:, 2] = 0
    means, truth = torch.cat([sphere, plane]), torch.arange(5_000) < 1_000
    found = members(means, means * 0, noisy(truth, g), n_links(means, means * 0))
    assert found[truth].float().mean() > 0.9 and found[~truth].float().mean() < 0.03
    cube = torch.rand(20_000, 3, generator=g) * 2 - 1
    ball = cube.norm(dim=1) < 0.6
    assert 2_000 < ball.sum() < 2_500
    assert not members(cube, cube * 0, noisy(ball, g), n_links(cube, cube * 0)).any()


def test_links_join_nine_others_once_each():
    means, dc, _ = random_scene(500, seed=3)
    means[:30] = means[0]  # coincident centres: a Gaussian may not be among its own ten nearest
    pairs, capacities = n_links(means, dc)
    assert (pairs[:, 0] < pairs[:, 1]).all() and len(pairs.unique(dim=0)) == len(pairs)
    assert capacities.isfinite().all() and (capacities > 0).all() and capacities.max() <= 2
    tree = torch.cdist(means[30:].double(), means.double()).argsort(dim=1)[:, 1:10]
    expected = {tuple(sorted((i + 30, int(j)))) for i, row in enumerate(tree) for j in row if j >= 30}
    assert {tuple(pair) for pair in pairs.tolist() if pair[0] >= 30} == expected
    assert 500 * 9 / 2 <= len(pairs) <= 500 * 9


def test_small_sets_and_broken_gaussians():
    means, dc, shares = random_scene(6, seed=0)
    means[5], dc[5], shares[5] = float("nan"), float("inf"), 0.0
    links = n_links(means, dc)
    assert members(means, dc, shares, links).shape == (6,)
    assert not members(means, dc, shares.clamp(max=0.89), links).any(), "no foreground, no object"
    assert members(means, dc, torch.ones(6), links).all(), "no rest"
    one = means[:1], dc[:1]
    assert members(*one, torch.ones(1), n_links(*one)).tolist() == [True]
    assert graph_cut.NUM_EDGES == 10 and graph_cut.FOREGROUND_THRESHOLD == 0.9
