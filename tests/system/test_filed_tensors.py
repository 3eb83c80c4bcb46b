"""Tensors in files, and stages of a preparation that never have all views in memory."""

from __future__ import annotations

import errno
import gc
import io
import weakref

import pytest
import torch
from labelled_views import labelled_views
from raster_scenes import CLASSES

from beags_plugin.labels.label_maps import CompressedMaps, LabelMaps
from beags_plugin.masks import REPROJECTIONS
from beags_plugin.masks.voxel_reprojection import reproject_voxel
from beags_plugin.options.stages import PreparationConfig
from beags_plugin.preparation import consistent_masks
from beags_plugin.preparation.pipeline import prepare
from beags_plugin.refiners import make_refiner
from beags_plugin.system import filed_tensors
from beags_plugin.system.errors import UserError
from beags_plugin.system.filed_tensors import filed
from beags_plugin.system.whole_files import write_whole

VALUES = [
    torch.tensor([[1.5, -0.0], [float("nan"), float("inf")]]),
    torch.arange(6, dtype=torch.float64).reshape(2, 3).T,
    torch.tensor([True, False]),
    torch.zeros(0, dtype=torch.int16),
    torch.tensor(7, dtype=torch.int32),
]


def same_bits(a, b):
    return a.dtype == b.dtype and a.shape == b.shape and a.numpy().tobytes() == b.numpy().tobytes()


def test_tensors_come_back_bit_for_bit():
    found = filed(iter(VALUES))
    assert len(found) == 5 and all(same_bits(a, b) for a, b in zip(found, VALUES, strict=True))
    assert same_bits(found[-1], VALUES[-1]) and [value.shape for value in found[1:3]] == [(3, 2), (2,)]
    with pytest.raises(IndexError):
        found[5]
    found[0].fill_(3)
    assert same_bits(found[0], VALUES[0])


def test_tensors_are_written_as_they_come_and_not_kept():
    alive: list[weakref.ref] = []

    def views():
        for index in range(5):
            gc.collect()
            assert sum(ref() is not None for ref in alive) <= 1
            values = torch.full((3,), float(index))
            alive.append(weakref.ref(values))
            yield values

    gc.freeze()  # the collector looks at nothing older, which would take seconds
    try:
        assert [float(value[0]) for value in filed(views())] == [0, 1, 2, 3, 4]
    finally:
        gc.unfreeze()


def test_a_full_disk_is_reported(monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(filed_tensors, "write_tensors", full)
    with pytest.raises(UserError, match="is full: free some space there, or name another folder with TMPDIR"):
        filed(VALUES)


class _FullDisk(io.RawIOBase):
    """Writing bytes fails, both when the buffer is flushed and when the file is closed."""

    def writable(self):
        return True

    def tell(self):
        return 0

    def write(self, data):
        raise OSError(errno.ENOSPC, "no space left on device")


def test_a_full_disk_is_reported_also_where_closing_fails_again(monkeypatch):
    monkeypatch.setattr(filed_tensors.tempfile, "TemporaryFile", lambda **_: io.BufferedWriter(_FullDisk()))
    with pytest.raises(UserError, match="is full: free some space there"):
        filed([torch.zeros(10)])


def test_what_could_not_be_written_leaves_nothing_behind(tmp_path):
    path = tmp_path / "some.npz"
    write_whole(path, lambda file: file.write(b"former"))

    def breaks(file):
        file.write(b"half")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_whole(path, breaks)
    assert [other.name for other in tmp_path.iterdir()] == ["some.npz"] and path.read_bytes() == b"former"


class Counting:
    """Views that count how many of them are held at a time."""

    def __init__(self, make, count):
        self.make, self.count, self.alive, self.most = make, count, [], 0

    def __len__(self):
        return self.count

    def __getitem__(self, index):
        if index >= self.count:
            raise IndexError
        made = self.make(index)
        self.alive = [ref for ref in self.alive if ref() is not None] + [weakref.ref(made)]
        self.most = max(self.most, len(self.alive))
        return made


@pytest.mark.usefixtures("ops")
def test_the_voxel_form_holds_one_view_at_a_time():
    surfels, cameras, masks, rasterizer, settings = labelled_views(9, 0.1)
    depths = list(consistent_masks.render_depths(surfels, cameras, rasterizer, settings, "median"))
    expected = list(reproject_voxel(depths, cameras, masks, CLASSES))
    lazy = Counting(lambda index: depths[index].clone(), len(depths))
    maps = Counting(lambda index: masks[index % 3].clone(), 9)
    found = [(each.labels, each.confidence) for each in reproject_voxel(lazy, cameras, masks, CLASSES)]
    assert lazy.most <= 3  # a loop over a zip holds one until it has the next
    assert all(
        torch.equal(a, b.labels) and torch.equal(c, b.confidence) for (a, c), b in zip(found, expected, strict=True)
    )
    list(reproject_voxel(depths[:3] * 3, cameras[:3] * 3, maps, CLASSES))
    assert maps.most <= 3


def test_what_is_prepared_from_files_is_what_is_prepared_from_memory():
    surfels, cameras, masks, rasterizer, settings = labelled_views(9, 0.1)
    names = {index: str(index) for index in range(CLASSES)}

    def prepared(name):
        config = PreparationConfig(reprojection=name, k=20)
        refiner = make_refiner("bea", {})
        found = prepare(surfels, cameras, masks, names, rasterizer, settings, refiner, config)
        assert isinstance(found.labels, LabelMaps) and isinstance(found.confidence, CompressedMaps)
        return [*found.labels, *found.confidence, found.assignment.margin, found.grid.keys, found.grid.classes]

    for name in ("voxel", "pairwise"):
        depths = list(consistent_masks.render_depths(surfels, cameras, rasterizer, settings, "median"))
        direct = [each.labels for each in REPROJECTIONS.get(name)(depths, cameras, masks, CLASSES)]
        found = prepared(name)
        assert all(torch.equal(a, b) for a, b in zip(direct, found[: len(cameras)], strict=True))
