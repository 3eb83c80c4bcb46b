"""Views streamed from disk are those kept in memory, bit for bit, and few of them are held at a time."""

from __future__ import annotations

import threading

import pytest
import torch
from data_folders import HEIGHT, WIDTH, write_transforms
from distorted_views import manager, write_distorted

from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.labels.label_maps import CompressedMap, to_int32
from beags_plugin.views import data_options
from beags_plugin.views.streaming import Lazy, StreamedViews


def both(root, **options):
    return [manager(root, stream=stream, **options) for stream in ("never", "always")]


def same(a: dict, b: dict) -> bool:
    tensors = {key for key in a if isinstance(a[key], torch.Tensor)}
    return a.keys() == b.keys() and all(torch.equal(a[key], b[key]) and a[key].dtype == b[key].dtype for key in tensors)


@pytest.mark.parametrize("kind", ["uint8", "float32"])
@pytest.mark.parametrize("model", ["OPENCV", "OPENCV_FISHEYE"])
def test_batches_and_views_are_the_same_bit_for_bit(tmp_path, model, kind):
    write_distorted(tmp_path, model, [(0.1, 0.1), (-0.2, 0.0)])
    cached, streamed = both(tmp_path, cache_images_type=kind)
    for step in range(16):  # two rounds
        (camera, batch), (other, found) = cached.next_train(step), streamed.next_train(step)
        assert batch["image_idx"] == found["image_idx"] and same(batch, found)
        assert torch.equal(camera.get_intrinsics_matrices(), other.get_intrinsics_matrices())
        assert torch.equal(camera.metadata["labels"], other.metadata["labels"])
    for split in ("train", "test"):
        for a, b in zip(cached.views(split), streamed.views(split), strict=True):
            assert torch.equal(a.image, b.image) and torch.equal(a.camera.K, b.camera.K) and a.name == b.name
            assert (a.labels is None and b.labels is None) or torch.equal(a.labels, b.labels)
    batches = zip(cached.fixed_indices_eval_dataloader, streamed.fixed_indices_eval_dataloader, strict=True)
    assert all(same(a, b) for (_, a), (_, b) in batches)
    assert same(cached.next_eval_image(0)[1], streamed.next_eval_image(0)[1])


def test_it_is_chosen_by_the_size_of_the_images(tmp_path, monkeypatch):
    write_transforms(tmp_path)
    gigabytes = 7 * WIDTH * HEIGHT * 3 / 1e9
    for factor, kind, expected in ((1.01, "uint8", False), (0.99, "uint8", True), (1.01, "float32", True)):
        monkeypatch.setattr(data_options, "STREAM_ABOVE", factor * gigabytes)
        data = manager(tmp_path, cache_images_type=kind)
        assert data.streams("train") is expected
        assert isinstance(data.cached_train, StreamedViews) is expected


def test_few_views_are_loaded_ahead_and_none_is_kept():
    loaded, alive = [], []
    lock = threading.Lock()

    class Data(dict):
        def __init__(self, index):
            super().__init__(index=index, image=torch.full((3,), float(index)))
            with lock:
                loaded.append(index)
                alive.append(index)

        def __del__(self):
            alive.remove(self["index"])

    views = StreamedViews(Data, 50, ahead=4, workers=2)
    order = list(range(50))[::-1]
    for place, index in enumerate(order):
        assert float(views[index]["image"][0]) == index
        views.expect(order[place + 1 :])
        assert len(alive) <= 5  # four ahead, one that is being handed over
    assert sorted(loaded) == sorted(order)  # each was loaded once
    views.expect([7, 8])
    views.expect([9])
    assert set(views._coming) == {9} and views[-1]["index"] == 49
    with pytest.raises(IndexError):
        views[50]


def test_a_failure_while_loading_ahead_is_raised_where_the_view_is_asked_for():
    def load(index):
        raise OSError(f"view {index} is gone")

    views = StreamedViews(load, 3, ahead=2, workers=1)
    views.expect([1])
    with pytest.raises(OSError, match="view 1 is gone"):
        views[1]


@pytest.mark.parametrize("ids", [(0, 3, IGNORE), (0, 300, IGNORE), (0, 70000)])
def test_packed_maps_are_small_and_give_every_id_back(ids):
    labels = torch.tensor(ids, dtype=torch.int32).repeat_interleave(40_000).reshape(-1, 200)
    packed = CompressedMap(labels)
    assert torch.equal(to_int32(packed.unpacked()), labels) and len(packed.packed) < 0.02 * labels.numel()


def test_lazy_sequences():
    lazy = Lazy(lambda index: index * 10, 3)
    assert list(lazy) == [0, 10, 20] and lazy[-1] == 20 and lazy[1:] == [10, 20] and len(lazy) == 3
