"""Objects picked one after another, corrected, and given to the classes of a run."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from touching_solids import SETTINGS, marks, overlap, solids, views

from beags_plugin.core.membership import Membership
from beags_plugin.picking.cutter import Cutter
from beags_plugin.picking.picks import Picks
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.system.errors import UserError

COLOURED = {0: (0.6, 0.6, 0.6), 1: (0.8, 0.2, 0.2), 2: (0.2, 0.3, 0.8)}
LOW, HIGH, FLOOR = (-0.2, 0.0, 0.25), (0.15, 0.0, 0.5), (-0.7, 0.3, 0.0)


@pytest.fixture(scope="module")
def scene():
    surfels, owner = solids(COLOURED)
    return Cutter(surfels, views(), make_rasterizer("auto"), SETTINGS), owner


def on(point):
    return marks(views()[3], [point])


def beside(point):
    return marks(views()[3], [], [point])


def test_two_objects_are_picked_in_turn(scene):
    cutter, owner = scene
    picks = Picks().marked(cutter, on(LOW)).named("low").another().marked(cutter, on(HIGH))
    assert [one.name for one in picks.objects] == ["low", "object 1"] and picks.place == 1
    assert picks.another().another().place == 2, "an object without a mark is the next one"
    members, names = picks.applied(Membership(torch.zeros(len(owner), dtype=torch.int32)), {0: "background"})
    assert names == {0: "background", 1: "low", 2: "object 1"} and members.class_ids.dtype == torch.int32
    assert overlap(members.of(1), owner == 1) > 0.95 and overlap(members.of(2), owner == 2) > 0.95
    assert torch.equal(picks.owners(len(owner)) == 1, picks.objects[1].members)
    assert not picks.objects[0].members.equal(picks.choose(0).marked(cutter, on(FLOOR)).chosen.members)


def test_a_mark_that_fails_leaves_all_as_it_was(scene):
    cutter, _ = scene
    picks = Picks().marked(cutter, on(LOW))
    for wrong, message in ((beside(LOW), "contradicts"), (marks(views()[3], [], [], torch.zeros(90, 96) > 0), "limit")):
        with pytest.raises(UserError, match=message):
            picks.marked(cutter, wrong)
    with pytest.raises(UserError, match="no point lies on object 1"):
        Picks().marked(cutter, beside(FLOOR))
    with pytest.raises(UserError, match="contradicts"):
        picks.another().marked(cutter, on(LOW))
    with pytest.raises(UserError, match="nothing of object 1 has been picked"):
        Picks().grown(cutter, 1)


def test_growing_takes_more_and_shrinking_less(scene):
    cutter, _ = scene
    picks = Picks().marked(cutter, on(LOW))
    sizes = []
    former = None
    for steps in (-12, -6, 0, 4, 8):
        members = picks.grown(cutter, steps).chosen.members
        assert former is None or not (former & ~members).any(), "what grows keeps what it had"
        former = members
        sizes.append(int(members.sum()))
    assert sizes[0] < sizes[2] < sizes[-1]
    with pytest.raises(UserError, match="takes the whole scene"):
        picks.grown(cutter, 60)
    there = picks.grown(cutter, 3).grown(cutter, -3)
    assert there.chosen.growth == 0 and torch.equal(there.chosen.members, picks.chosen.members)


def test_what_is_hidden_stops_no_mark(scene):
    """Without the high block a point on it lies on the floor behind."""
    cutter, owner = scene
    found = cutter.solve([replace(on(HIGH), drawn=owner != 2), beside(LOW), beside(HIGH)])
    assert overlap(found, owner == 0) > 0.8 and not found[owner == 2].any()


def test_an_object_is_corrected_by_what_is_taken_from_it_and_added(scene):
    cutter, owner = scene
    means = solids(COLOURED)[0].means
    wrong = (owner == 1) & (means[:, 0] < -0.1) | (owner == 2)  # a part is missing, and it has the other block
    picks = Picks().correcting("low", 5, wrong)
    assert picks.changed() == [] and picks.correcting("low", 5, wrong).objects == picks.objects
    picks = picks.marked(cutter, beside(HIGH))
    assert overlap(picks.chosen.members, (owner == 1) & wrong) > 0.9
    picks = picks.marked(cutter, on((-0.05, 0.0, 0.25)))
    assert overlap(picks.chosen.members, owner == 1) > 0.95
    ids = torch.where(wrong, 5, 0).int()
    members, names = picks.applied(Membership(ids), {0: "background", 5: "low", 6: "other"})
    assert names[5] == "low" and torch.equal(members.of(5), picks.chosen.members)
    assert (members.class_ids[(owner == 2) & ~picks.chosen.members] == 0).all()
    with pytest.raises(UserError, match="nothing of low is there"):
        Picks().correcting("low", 5, owner == 1).marked(cutter, beside(FLOOR))


def test_a_correction_that_leaves_nothing_is_refused(scene):
    cutter, owner = scene
    with pytest.raises(UserError, match="low"):
        Picks().correcting("low", 5, owner == 1).marked(cutter, beside(LOW))


@pytest.mark.parametrize("reverse", [False, True])
def test_the_smallest_object_has_what_several_hold(scene, reverse):
    """A block within all solids, which lie within the whole scene, in whatever order they were picked."""
    _, owner = scene
    nested = [("all", owner >= 0), ("solids", owner >= 1), ("low", owner == 1)]
    objects = tuple(
        replace(Picks().chosen, name=n, marks=(on(LOW),), members=m) for n, m in (nested[::-1] if reverse else nested)
    )
    picks = Picks(objects)
    members, names = picks.applied(Membership(torch.zeros(len(owner), dtype=torch.int32)), {0: "background"})
    ids = {name: class_id for class_id, name in names.items()}
    wanted = {"all": owner == 0, "solids": owner == 2, "low": owner == 1}
    for place, one in enumerate(objects):
        assert torch.equal(members.of(ids[one.name]), wanted[one.name])
        assert torch.equal(picks.owners(len(owner)) == place, wanted[one.name])


def test_the_last_of_two_as_large_has_what_both_hold_and_shared_gaussians_are_known(scene):
    _, owner = scene
    low, size = (owner == 1).nonzero()[:, 0], int(min((owner == 0).sum(), (owner == 2).sum()))
    first, last = (torch.zeros(len(owner), dtype=torch.bool) for _ in range(2))
    for members, number in ((first, 0), (last, 2)):
        members[(owner == number).nonzero()[:size, 0]] = True
        members[low] = True
    mark = on(LOW)
    objects = tuple(replace(Picks().chosen, name=n, marks=(mark,), members=m) for n, m in (("a", first), ("b", last)))
    shared = Membership(torch.zeros(len(owner), dtype=torch.int32), {7: torch.arange(len(owner))})
    members, names = Picks(objects).applied(shared, {0: "background", 7: "all"})
    assert names == {0: "background", 7: "all", 8: "a", 9: "b"}
    assert torch.equal(members.of(8), first & ~last) and torch.equal(members.of(9), last)
    assert torch.equal(members.of(7), ~(first | last))


def test_an_object_gets_the_id_that_the_masks_of_the_data_give_to_its_name(scene):
    _, owner = scene
    objects = tuple(
        replace(Picks().chosen, name=n, marks=(on(LOW),), members=owner == i) for i, n in ((1, "a"), (2, "b"))
    )
    known = {0: "background", 3: "b", 4: "c"}
    members, names = Picks(objects).applied(Membership(torch.zeros(len(owner), dtype=torch.int32)), known)
    assert names == {**known, 5: "a"} and torch.equal(members.class_ids.long(), (owner == 1) * 5 + (owner == 2) * 3)


@pytest.mark.parametrize(
    ("names", "message"), [(("a", "a"), "two objects called 'a'"), (("a", " "), "has no name"), (("cup", "a"), "cup")]
)
def test_names_are_checked(scene, names, message):
    _, owner = scene
    objects = tuple(replace(Picks().chosen, name=name, marks=(on(LOW),), members=owner == 1) for name in names)
    with pytest.raises(UserError, match=message):
        Picks(objects).applied(Membership((owner == 0).int()), {0: "background", 1: "cup"})
    with pytest.raises(UserError, match="nothing has been picked"):
        Picks().applied(Membership(torch.zeros(4, dtype=torch.int32)), {})
