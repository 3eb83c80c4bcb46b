""".spz files, read back by a reader written from the format's description."""

from __future__ import annotations

import gzip
import math

import numpy as np
import pytest
import torch
from random_surfels import camera_at, drawn, psnr, random_surfels
from run_folders import discs

from beags_plugin.core.sh import sh_colors
from beags_plugin.core.surfels import Surfels
from beags_plugin.export.base import ExportItem, make_exporter
from beags_plugin.export.spz import fractional_bits
from beags_plugin.system.errors import UserError
from benchmarks.splat_readers import SH_SIGNS, in_ply_axes, surfels_of
from benchmarks.splat_readers import read_spz as read


def write(path, surfels: Surfels, **options) -> dict:
    return make_exporter("spz", **options).write(path, ExportItem("cup", surfels, torch.zeros(len(surfels))))


def read_back(path) -> Surfels:
    return surfels_of(in_ply_axes(read(path)))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_every_parameter_comes_back_as_exactly_as_the_format_allows(tmp_path, degree):
    surfels = random_surfels(count=50, degree=degree)
    facts = write(tmp_path / "cup.spz", surfels, first_band_bits=8, other_bands_bits=8)
    arrays = read(tmp_path / "cup.spz")
    back = surfels_of(in_ply_axes(arrays))
    assert facts["sh_degree"] == back.sh_degree == degree
    step = 2.0 ** -facts["fractional_bits"]
    assert (back.means - surfels.means).abs().max() <= step and step < 1e-5
    assert (back.log_scales - surfels.log_scales).abs().max() <= 1 / 32 + 1e-5
    assert (torch.sigmoid(back.opacity_logits) - torch.sigmoid(surfels.opacity_logits)).abs().max() <= 0.5 / 255 + 1e-5
    assert (back.sh_dc - surfels.sh_dc).abs().max() <= 0.5 / 255 / 0.15 + 1e-5
    # 8 bits of x, y and z; w, their rest, is less exact where it is small
    quats = torch.nn.functional.normalize(surfels.quats, dim=1)
    assert ((back.quats * quats).sum(dim=1).abs() > 0.99).all()
    assert (arrays["quats"][:, 0] >= 0).all()
    if degree:
        inside = surfels.sh_rest.abs() < 0.99
        assert (
            (back.sh_rest - surfels.sh_rest).abs()[inside] <= 0.5 / 128 + 1e-5
        ).all() and inside.float().mean() > 0.9
    smaller = surfels.log_scales.min(dim=1).values.numpy()
    expected = np.clip(smaller + math.log(1e-3), -10.0, 255 / 16 - 10)
    assert np.abs(arrays["log_scales"][:, 2] - expected).max() <= 1 / 32 + 1e-5


def test_the_signs_of_the_bands_are_those_of_the_turned_directions():
    """Checks this file's own table, with the renderer's colours."""
    surfels = random_surfels(count=20, dtype=torch.float64)
    turn = torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)
    rest = surfels.sh_rest * torch.from_numpy(SH_SIGNS)[:, None]
    eye = torch.tensor([0.3, -2.0, 1.0], dtype=torch.float64)
    before = sh_colors(surfels.sh_dc, surfels.sh_rest, surfels.means, eye, 3)
    assert torch.allclose(sh_colors(surfels.sh_dc, rest, surfels.means * turn, eye * turn, 3), before, atol=1e-12)


def test_a_known_gaussian_has_known_bytes(tmp_path):
    """By hand, from the description; y and z are turned."""
    c, s = math.cos(0.3), math.sin(0.3)
    surfel = Surfels(
        torch.tensor([[1.0, -0.5, 0.25]]),
        torch.tensor([[-c, -s, 0.0, 0.0]]),  # w < 0: the same rotation as (c, s, 0, 0), about x: kept
        torch.tensor([[-2.0, 1.0]]),
        torch.tensor([0.0]),
        torch.tensor([[0.0, 1.0, -9.0]]),
        torch.tensor([[[0.5, -0.25, 0.0], [0.125, 2.0, -2.0], [0.0, 0.02, 0.26]]]),
    )
    facts = write(tmp_path / "one.spz", surfel)
    assert facts == {"version": 2, "fractional_bits": 22, "sh_degree": 1}
    expected = [
        *(0x4E, 0x47, 0x53, 0x50), *(2, 0, 0, 0), *(1, 0, 0, 0), 1, 22, 0, 0,
        *(0, 0, 0x40), *(0, 0, 0x20), *(0, 0, 0xF0),
        128,
        *(128, 166, 0),
        *(128, 176, round(16 * (8 + math.log(1e-3)))),
        *(round(127.5 + 127.5 * s), 128, 128),
        # y, z and x of band 1: y and z are turned; steps of 8
        *(64, 160, 128), *(112, 0, 255), *(128, 128, 160),
    ]  # fmt: skip
    assert list(gzip.decompress((tmp_path / "one.spz").read_bytes())) == expected


def test_a_read_file_looks_the_same(tmp_path):
    surfels, _ = discs()
    write(tmp_path / "scene.spz", surfels)
    back = read_back(tmp_path / "scene.spz")
    for eye in ((2.0, 1.0, 1.5), (-1.0, 2.0, -0.5)):
        camera = camera_at(eye)
        before = drawn(surfels, camera)
        assert before.std() > 0.1 and psnr(before, drawn(back, camera)) > 28
    fine = {"first_band_bits": 8, "other_bands_bits": 8}
    write(tmp_path / "fine.spz", surfels, **fine)
    assert psnr(before, drawn(read_back(tmp_path / "fine.spz"), camera)) > 32


def test_the_same_bytes_again_and_much_smaller_than_a_ply(tmp_path):
    surfels = random_surfels(count=2000)
    write(tmp_path / "a.spz", surfels)
    write(tmp_path / "b.spz", surfels)
    make_exporter("ply").write(tmp_path / "a.ply", ExportItem("cup", surfels, torch.zeros(2000, dtype=torch.int32)))
    assert (tmp_path / "a.spz").read_bytes() == (tmp_path / "b.spz").read_bytes()
    assert (tmp_path / "a.spz").stat().st_size * 4 < (tmp_path / "a.ply").stat().st_size


def test_no_reader_gets_an_infinite_logit(tmp_path):
    surfels = random_surfels()
    surfels.opacity_logits[:2] = torch.tensor([-20.0, 20.0])
    write(tmp_path / "a.spz", surfels)
    assert (255 * read(tmp_path / "a.spz")["alphas"])[:2].tolist() == [1, 254]


def test_what_is_not_finite_is_left_out_and_nothing_is_a_file_too(tmp_path):
    surfels = random_surfels()
    surfels.means[2, 1], surfels.opacity_logits[4] = math.nan, math.inf
    write(tmp_path / "a.spz", surfels)
    assert len(read(tmp_path / "a.spz")["means"]) == 5
    write(tmp_path / "none.spz", surfels[:0])
    assert len(read(tmp_path / "none.spz")["means"]) == 0


@pytest.mark.parametrize(("reach", "bits"), [(0.0, 23), (0.9, 23), (1.0, 22), (2000.0, 12), (8e6, 0)])
def test_positions_get_all_the_bits_there_are(reach, bits):
    assert fractional_bits(reach) == bits
    assert round(reach * 2**bits) <= 2**23 - 1


def test_mistakes(tmp_path):
    with pytest.raises(UserError, match=r"reaches 1e\+07 units from the origin"):
        fractional_bits(1e7)
    with pytest.raises(UserError, match="first_band_bits is 9"):
        make_exporter("spz", first_band_bits=9)
