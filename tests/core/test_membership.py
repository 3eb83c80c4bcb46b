"""Classes of Gaussians that overlap and leave gaps."""

import torch
from random_surfels import random_surfels

from beags_plugin.core.membership import Membership
from beags_plugin.core.select import remove_class, select_class

PHI = torch.tensor([0, 2, 1, 2, 0, 2, 1], dtype=torch.int32)
# 1 and 2 share Gaussian 3; 5, of class 2 by phi, belongs to nobody; 4, background by phi, to 1
OVERLAPPING = Membership.of_masks(
    {1: torch.tensor([0, 0, 1, 1, 1, 0, 1]).bool(), 2: torch.tensor([0, 1, 0, 1, 0, 0, 0]).bool()}, PHI
)


def test_classes_alone_are_exclusive():
    members = Membership(PHI)
    assert members.present() == [0, 1, 2]
    assert sum(members.of(c).int() for c in (0, 1, 2)).tolist() == [1] * 7
    assert not members.of(3).any()


def test_objects_may_overlap_and_leave_gaps():
    assert OVERLAPPING.of(1).nonzero()[:, 0].tolist() == [2, 3, 4, 6]
    assert OVERLAPPING.of(2).nonzero()[:, 0].tolist() == [1, 3]
    assert OVERLAPPING.of(0).nonzero()[:, 0].tolist() == [0, 5], "the background is what no object has"
    assert OVERLAPPING.present() == [0, 1, 2]
    assert not OVERLAPPING.of(3).any()


def test_the_class_that_a_viewer_shows_is_phi_where_that_is_among_the_objects():
    assert OVERLAPPING.class_ids.tolist() == [0, 2, 1, 2, 1, 0, 1]


def test_a_part_keeps_its_overlaps():
    part = OVERLAPPING[torch.tensor([3, 5, 4])]
    assert [part.of(c).tolist() for c in (0, 1, 2)] == [[False, True, False], [True, False, True], [True, False, False]]
    assert Membership(PHI)[torch.tensor([1])].present() == [2]


def test_objects_that_overlap_are_extracted_and_removed_whole():
    surfels = random_surfels()
    assert select_class(surfels, OVERLAPPING, 1)[1].tolist() == [2, 3, 4, 6]
    assert remove_class(surfels, OVERLAPPING, 2)[1].tolist() == [0, 2, 4, 5, 6]
