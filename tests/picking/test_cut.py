"""The cut of solids on a floor by a few marks."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from touching_solids import SETTINGS, marks, overlap, pixel_of, solids, views

from beags_plugin.core.regions import Ball, Block, HalfSpace
from beags_plugin.picking.cutter import Cutter, takes_little, takes_much
from beags_plugin.picking.walk import Walker
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.rasterizers.interface import FLOATS
from beags_plugin.system.errors import UserError

GREY = (0.5, 0.5, 0.5)
COLOURED = {0: (0.6, 0.6, 0.6), 1: (0.8, 0.2, 0.2), 2: (0.2, 0.3, 0.8)}
LOW_TOP, HIGH_TOP, FLOOR = (-0.2, 0.0, 0.25), (0.15, 0.0, 0.5), (-0.7, 0.3, 0.0)


def cutter_of(colors) -> tuple[Cutter, torch.Tensor]:
    surfels, owner = solids(colors)
    return Cutter(surfels, views(), make_rasterizer("auto"), SETTINGS), owner


@pytest.fixture(scope="module")
def coloured():
    return cutter_of(COLOURED)


@pytest.fixture(scope="module")
def grey():
    return cutter_of(dict.fromkeys(range(3), GREY))


@pytest.mark.parametrize("scene", ["coloured", "grey"])
@pytest.mark.parametrize("solid", [1, 2])
def test_a_solid_is_cut_from_the_one_that_it_touches_and_from_the_floor(scene, solid, request):
    """Colours and creases tell solids apart; where all is grey, creases alone do."""
    cutter, owner = request.getfixturevalue(scene)
    own, other = (LOW_TOP, HIGH_TOP) if solid == 1 else (HIGH_TOP, LOW_TOP)
    found = cutter.solve([marks(views()[3], [own], [other, FLOOR])])
    assert overlap(found, owner == solid) > 0.97


def test_a_second_cut_after_a_point_beside_takes_the_other_solid_away(grey):
    cutter, owner = grey
    camera = views()[3]
    both = cutter.solve([marks(camera, [LOW_TOP, HIGH_TOP], [FLOOR])])
    assert overlap(both, owner > 0) > 0.97
    less = cutter.solve([marks(camera, [LOW_TOP], [HIGH_TOP, FLOOR])])
    assert overlap(less, owner == 1) > 0.97
    again = cutter.solve([marks(camera, [LOW_TOP, HIGH_TOP], [FLOOR])])
    assert torch.equal(both, again), "a cut depends on those before"


def test_marks_on_other_objects_take_nothing_but_what_they_show(grey):
    """A sticker's mark on the high block; one beside the block takes the half of it that is nearer."""
    cutter, owner = grey
    camera = views()[3]
    sticker = marks(camera, [], [(0.15, 0.28, 0.5)])
    own = marks(camera, [(0.15, -0.28, 0.5)], [LOW_TOP, FLOOR])
    beside = cutter.solve([own, sticker])
    other = cutter.solve([own, replace(sticker, of_others=True)])
    assert overlap(beside, owner == 2) < 0.8
    assert overlap(other, owner == 2) > 0.9


def test_marks_of_several_views_act_together(coloured):
    cutter, owner = coloured
    found = cutter.solve([marks(views()[3], [LOW_TOP]), marks(views()[5], [], [HIGH_TOP, FLOOR])])
    assert overlap(found, owner == 1) > 0.97


class OtherDevice:
    """A rasterizer on a device without memory: it refuses tensors from elsewhere, and answers as one on the CPU."""

    def __init__(self, inputs, labels: torch.Tensor) -> None:
        self.inputs, self.labels = inputs, labels

    def sparse_class_contributions(self, inputs, camera, settings, labels, num_classes):
        given = [getattr(inputs, field.name) for field in fields(inputs)]
        devices = {tensor.device.type for tensor in (*given, labels) if isinstance(tensor, torch.Tensor)}
        assert devices == {"meta"}, devices
        return make_rasterizer("auto").sparse_class_contributions(
            self.inputs, camera, settings, self.labels, num_classes
        )


def test_marks_go_to_the_device_of_the_gaussians():
    cutter, _ = cutter_of(COLOURED)
    mark = marks(views()[3], [LOW_TOP], [HIGH_TOP, FLOOR])
    expected = cutter.solve([mark])
    floats = {name: getattr(cutter._inputs, name).to("meta") for name in FLOATS}
    cutter._rasterizer = OtherDevice(cutter._inputs, mark.numbers)
    cutter._inputs = replace(cutter._inputs, **floats)
    assert torch.equal(cutter.solve([mark]), expected)
    everything = torch.ones(len(expected), dtype=torch.bool)
    assert torch.equal(cutter.solve([replace(mark, drawn=everything)]), expected)


def test_what_lies_outside_a_box_is_excluded(coloured):
    cutter, _ = coloured
    camera = views()[3]
    within = torch.zeros(camera.height, camera.width, dtype=torch.bool)
    row, column = pixel_of(camera, LOW_TOP)
    within[row - 6 : row + 7, column - 6 : column + 7] = True
    found = cutter.solve([marks(camera, [LOW_TOP], within=within)])
    surfels, _ = solids(COLOURED)
    assert found.any()
    for mean in surfels.means[found]:
        assert within[pixel_of(camera, tuple(mean.tolist()))]


def test_regions_of_space_limit_the_cut(coloured):
    cutter, owner = coloured
    means = solids(COLOURED)[0].means.double()
    halves = [HalfSpace((-1.0, 0.0, 0.0), 0.2), Block((-9, -9, -9), (-0.2, 9, 9)), Ball((-10.2, 0.0, 0.0), 10.0)]
    for region in halves:
        outside = ~region.contains(means)
        found = cutter.solve([marks(views()[3], [(-0.3, 0.0, 0.25)], [FLOOR])], outside)
        assert found.any() and not (found & outside).any()
        assert overlap(found, (owner == 1) & ~outside) > 0.95


def test_bad_marks_end_with_a_sentence(coloured):
    cutter, _ = coloured
    camera = views()[3]
    with pytest.raises(UserError, match="no point lies on the cup: give at least one"):
        cutter.solve([marks(camera, [], [FLOOR])], name="the cup")
    two_views = [marks(camera, [LOW_TOP]), marks(views()[4], [], [LOW_TOP])]
    with pytest.raises(UserError, match="contradicts another point"):
        cutter.solve(two_views)
    sky = marks(camera, [LOW_TOP])
    sky.numbers[sky.numbers == 0] = 65535
    sky.numbers[-3:, :3] = 0
    with pytest.raises(UserError, match="a point on the object in v0 shows nothing"):
        cutter.solve([sky])
    nowhere = torch.zeros(camera.height, camera.width, dtype=torch.bool)
    with pytest.raises(UserError, match="lies outside a box or another limit"):
        cutter.solve([marks(camera, [LOW_TOP], within=nowhere)])


def test_a_cut_that_a_limit_leaves_nothing_of_is_refused(coloured, monkeypatch):
    """The point on the object shows two Gaussians: a limit leaves out one, and the point beside has the other."""
    cutter, owner = coloured
    shares = np.zeros((2, len(cutter._graph.nodes)))
    shares[0, :2], shares[1, 1] = (0.6, 0.4), 0.9
    monkeypatch.setattr(cutter, "_shares", lambda view: shares)
    excluded = torch.zeros(len(owner), dtype=torch.bool)
    excluded[cutter._graph.nodes[0]] = True
    with pytest.raises(UserError, match="the cut of the cup takes nothing: mark points on it"):
        cutter.solve([marks(views()[3], [LOW_TOP], [FLOOR])], excluded, "the cup")


@pytest.mark.parametrize("count", [50, 51])
def test_a_cut_of_more_than_half_of_the_scene_is_said(count):
    said = takes_much(torch.arange(100) < count)
    assert said is None if count == 50 else said is not None and "more than half of the scene (51%)" in said
    assert "(51%)" in str(takes_much(torch.arange(1000) < 501))


@pytest.mark.parametrize("count, scene, is_said", [(2, 9_000, True), (20, 9_000, False), (99, 10**6, True)])
def test_a_cut_that_has_hardly_left_its_points_is_said(count, scene, is_said):
    assert ("click on other parts" in str(takes_little(torch.arange(scene) < count))) is is_said


def test_a_cut_of_the_whole_scene_is_refused():
    surfels, owner = solids(COLOURED)
    camera = views()[3]
    alone = Cutter(surfels[owner == 1], views(), make_rasterizer("auto"), SETTINGS)
    with pytest.raises(UserError, match="takes the whole scene"):
        alone.solve([marks(camera, [LOW_TOP])])


def test_the_potential_solves_its_equation_and_lies_between_the_marks(grey):
    walker: Walker = grey[0]._walker
    count = len(walker._degree)
    inside, outside = np.zeros(count, bool), np.zeros(count, bool)
    inside[count // 2], outside[0] = True, True
    p = walker.potential(inside, outside, *np.zeros((2, count), bool))
    free = ~(inside | outside)
    residual = (walker._degree * p - walker._links @ p)[free]
    assert p[inside] == 1 and p[outside] == 0 and (p >= 0).all() and (p <= 1).all()
    assert np.abs(residual).max() < 1e-3 * (walker._links @ inside).max()


SCRIPT = """
import hashlib, sys, torch
torch.set_num_threads(int(sys.argv[1]))
from touching_solids import SETTINGS, marks, solids, views
from beags_plugin.picking.cutter import Cutter
from beags_plugin.rasterizers import make_rasterizer
surfels, _ = solids({0: (0.5, 0.5, 0.5), 1: (0.6, 0.5, 0.5), 2: (0.5, 0.5, 0.6)})
cutter = Cutter(surfels, views(), make_rasterizer("auto"), SETTINGS)
found = cutter.solve([marks(views()[3], [(-0.2, 0.0, 0.25)])])
print(hashlib.sha256(cutter._graph.weights.tobytes() + found.numpy().tobytes()).hexdigest())
"""


@pytest.mark.slow("the same cut three times")
def test_bits_are_the_same_for_one_and_for_three_threads():
    digests = set()
    for threads in ("1", "3"):
        environment = os.environ | {"OMP_NUM_THREADS": threads, "OPENBLAS_NUM_THREADS": threads}
        environment["PYTHONPATH"] = os.pathsep.join(path for path in sys.path if path)
        done = subprocess.run(
            [sys.executable, "-c", SCRIPT, threads], capture_output=True, text=True, check=True, env=environment
        )
        digests.add(done.stdout)
    assert len(digests) == 1


@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU")
def test_a_scene_on_cuda_is_cut_by_marks_on_the_host(coloured):
    """Pages and files give marks on the host; the cut has the same Gaussians as on the CPU."""
    surfels, _ = solids(COLOURED)
    moved = type(surfels)(**{field.name: getattr(surfels, field.name).cuda() for field in fields(surfels)})
    cutter = Cutter(moved, views(), make_rasterizer("auto"), SETTINGS)
    given = [marks(views()[3], [LOW_TOP], [HIGH_TOP, FLOOR])]
    assert overlap(cutter.solve(given), coloured[0].solve(given)) > 0.99
