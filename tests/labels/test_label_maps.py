"""Label maps in the narrowest type: every id comes back, and votes are the same bit for bit."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from voted_views import METHODS, larger_scene, same

from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.labels.label_maps import LabelMaps, to_compact, to_int32


@given(st.lists(st.one_of(st.integers(0, 300), st.integers(65500, IGNORE)), min_size=1, max_size=12))
def test_every_id_comes_back(ids):
    wide = torch.tensor([ids], dtype=torch.int32)
    narrow = to_compact(wide)
    assert to_int32(narrow).dtype == torch.int32 and torch.equal(to_int32(narrow), wide)
    fits = all(value < 255 or value == IGNORE for value in ids)
    assert narrow.dtype == (torch.uint8 if fits else torch.uint16)


def test_255_classes_fit_in_a_byte_and_256_do_not():
    most = torch.arange(255, dtype=torch.int32)[None]
    assert to_compact(torch.cat([most, torch.tensor([[IGNORE]])], 1)).dtype == torch.uint8
    assert to_compact(torch.tensor([[255]])).dtype == torch.uint16
    assert to_compact(torch.tensor([[IGNORE + 1]])).dtype == torch.int32  # no id, which its reader refuses
    assert to_compact(torch.tensor([[-1]])).dtype == torch.int32


def test_maps_are_read_one_at_a_time():
    wide = torch.tensor([[0, 7, IGNORE]], dtype=torch.int32)
    maps = LabelMaps([wide, None, to_compact(wide)])
    assert len(maps) == 3 and maps[1] is None
    assert maps.stored[2] is LabelMaps(maps.stored).stored[2]  # held maps are not copied
    read = list(maps)
    assert torch.equal(read[0], wide) and torch.equal(read[2], wide) and read[0].dtype == torch.int32
    read[0].fill_(3)
    assert torch.equal(maps[0], wide) and len(maps[1:]) == 2


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("spread", [1, 100])
def test_votes_of_narrow_maps_are_the_same_bits(method, spread):
    depths, cameras, labels, num_classes = larger_scene(torch.float32)
    labels = [None if mask is None else torch.where(mask == IGNORE, mask, mask * spread) for mask in labels]
    maps = LabelMaps(labels)
    types = {mask.dtype for mask in map(maps.narrow, range(len(maps))) if mask is not None}
    assert types == {torch.uint8} if spread == 1 else torch.uint16 in types
    count = (num_classes - 1) * spread + 1
    wide = list(method(depths, cameras, labels, count))
    assert same(wide, list(method(depths, cameras, maps, count)))


def test_a_byte_of_255_is_no_class_even_where_there_are_so_many():
    depths, cameras, labels, _ = larger_scene(torch.float32)
    known = next(mask for mask in labels if mask is not None)
    assert bool((known == IGNORE).any()), "the scene has unlabelled pixels"
    method = METHODS[0]
    assert same(list(method(depths, cameras, labels, 256)), list(method(depths, cameras, LabelMaps(labels), 256)))
