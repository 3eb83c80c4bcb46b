"""The host's knowledge of classes and labels equals the tensors', until they change."""

from __future__ import annotations

import torch

from beags_plugin.labels.class_ids import IGNORE, objects_in
from beags_plugin.losses.class_members import ClassMembers


def test_members_are_the_places_of_a_class_in_their_order():
    class_ids = torch.tensor([3, 0, 7, 3, 0, 3], dtype=torch.int32)
    members = ClassMembers(class_ids)
    assert [members.of(class_id).tolist() for class_id in (0, 3, 7, 5)] == [[1, 4], [0, 3, 5], [2], []]
    assert members.of(3).dtype == torch.int64


def test_members_know_whether_the_ids_have_changed():
    class_ids = torch.zeros(4, dtype=torch.int32)
    members = ClassMembers(class_ids)
    assert members.current(class_ids)
    assert not members.current(class_ids.clone())  # another tensor, whatever it holds
    class_ids.copy_(torch.ones(4, dtype=torch.int32))
    assert not members.current(class_ids)


def test_no_surfels_and_an_empty_mask_are_no_error():
    assert len(ClassMembers(torch.zeros(0, dtype=torch.int32)).of(1)) == 0
    assert objects_in(torch.full((2, 3), IGNORE, dtype=torch.int32)) == []


def test_objects_are_all_but_background_and_ignore():
    labels = torch.tensor([[9, 0, IGNORE], [2, 2, 9]], dtype=torch.int32)
    assert objects_in(labels) == [2, 9]
