""".spz files: their bytes by hand, what is read of them, and what the reference library reads."""

from __future__ import annotations

import gzip
import math

import pytest
import torch
from other_programs import READ_BY_SPZ, read_by_spz
from random_surfels import camera_at, drawn, psnr, random_surfels
from run_folders import discs
from written_splats import angles, read_back, write

from beags_plugin.core.sh import sh_colors
from beags_plugin.core.surfels import Surfels, opacities
from beags_plugin.export.base import make_exporter
from beags_plugin.export.spz import fractional_bits
from beags_plugin.importers.base import read_scene
from beags_plugin.importers.spz import HALF_TURN_SIGNS
from beags_plugin.surfaces.item import ExportItem
from beags_plugin.system.errors import UserError

VERSIONS = pytest.mark.parametrize("version", [3, 4])


@pytest.fixture(autouse=True)
def zstandard(request):
    """Version 4 needs the library."""
    if getattr(request.node, "callspec", None) and request.node.callspec.params.get("version") == 4:
        pytest.importorskip("zstandard")


@VERSIONS
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_every_parameter_comes_back_as_exactly_as_the_format_allows(tmp_path, degree, version):
    surfels = random_surfels(count=50, degree=degree)
    path, item = tmp_path / "cup.spz", ExportItem("cup", surfels, torch.zeros(len(surfels)))
    facts = make_exporter("spz", version=version, first_band_bits=8, other_bands_bits=8).write(path, item)
    scene = read_scene(path)
    back = scene.gaussians
    assert scene.kind == f".spz version {version}" and facts["version"] == version
    assert facts["sh_degree"] == degree and back.sh_rest.shape == surfels.sh_rest.shape
    step = 2.0 ** -facts["fractional_bits"]
    assert (back.means - surfels.means).abs().max() <= step and step < 1e-5
    assert (back.log_scales[:, :2] - surfels.log_scales).abs().max() <= 1 / 32 + 1e-5
    assert (opacities(back.opacity_logits) - opacities(surfels.opacity_logits)).abs().max() <= 0.5 / 255 + 1e-5
    assert (back.sh_dc - surfels.sh_dc).abs().max() <= 0.5 / 255 / 0.15 + 1e-5
    if degree:
        inside = surfels.sh_rest.abs() < 0.99
        assert (
            (back.sh_rest - surfels.sh_rest).abs()[inside] <= 0.5 / 128 + 1e-5
        ).all() and inside.float().mean() > 0.9
    smaller = surfels.log_scales.min(dim=1).values
    expected = (smaller + math.log(1e-3)).clamp(-10.0, 255 / 16 - 10)
    assert (back.log_scales[:, 2] - expected).abs().max() <= 1 / 32 + 1e-5


@VERSIONS
def test_rotations_of_discs_come_back_within_half_a_degree(tmp_path, version):
    """8 bits of x, y and z, as in version 2, tilt discs by degrees."""
    surfels = random_surfels(count=20_000, degree=0)
    found = angles(read_back(write(tmp_path / "cup.spz", "spz", surfels, version=version)).quats, surfels.quats)
    assert found.max() < 0.25
    bytes_only = torch.nn.functional.normalize(surfels.quats, dim=1)
    bytes_only = bytes_only * bytes_only[:, :1].sign()
    three = (127.5 + 127.5 * bytes_only[:, 1:]).round() / 127.5 - 1
    w = (1 - three.square().sum(dim=1, keepdim=True)).clamp_min(0).sqrt()
    assert angles(torch.cat([w, three], dim=1), surfels.quats).max() > 5


@READ_BY_SPZ
@VERSIONS
@pytest.mark.parametrize("degree", [0, 3])
def test_the_reference_library_reads_the_same(tmp_path, degree, version):
    surfels = random_surfels(count=300, degree=degree)
    path = write(tmp_path / "cup.spz", "spz", surfels, version=version)
    ours, theirs = read_scene(path).gaussians, read_by_spz(path)
    assert (theirs["count"], theirs["degree"]) == (300, degree)

    def field(name: str, width: int) -> torch.Tensor:
        return torch.tensor(theirs[name]).reshape(300, width) if width else torch.zeros(300, 0)

    assert torch.allclose(field("positions", 3), ours.means, atol=1e-5)
    assert torch.allclose(field("scales", 3), ours.log_scales, atol=1e-5)
    assert torch.allclose(field("alphas", 1)[:, 0], ours.opacity_logits, atol=1e-4)
    assert torch.allclose(field("colors", 3), ours.sh_dc, atol=1e-5)
    assert angles(field("rotations", 4)[:, [3, 0, 1, 2]], ours.quats).max() < 1e-3
    width = ours.sh_rest[0].numel()
    assert torch.allclose(field("sh", width), ours.sh_rest.reshape(300, width), atol=1e-5)


def test_the_signs_of_the_bands_are_those_of_the_turned_directions():
    """Checks the reader's table, with the renderer's colours."""
    surfels = random_surfels(count=20, dtype=torch.float64)
    turn = torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)
    rest = surfels.sh_rest * torch.from_numpy(HALF_TURN_SIGNS)[:, None]
    eye = torch.tensor([0.3, -2.0, 1.0], dtype=torch.float64)
    before = sh_colors(surfels.sh_dc, surfels.sh_rest, surfels.means, eye, 3)
    assert torch.allclose(sh_colors(surfels.sh_dc, rest, surfels.means * turn, eye * turn, 3), before, atol=1e-12)


def test_a_known_gaussian_has_known_bytes(tmp_path):
    """The expected bytes are put together by hand, from the description; y and z are turned."""
    c, s = math.cos(0.3), math.sin(0.3)
    surfel = Surfels(
        torch.tensor([[1.0, -0.5, 0.25]]),
        torch.tensor([[-c, -s, 0.0, 0.0]]),  # w < 0: the same rotation as (c, s, 0, 0), about x: kept
        torch.tensor([[-2.0, 1.0]]),
        torch.tensor([0.0]),
        torch.tensor([[0.0, 1.0, -9.0]]),
        torch.tensor([[[0.5, -0.25, 0.0], [0.125, 2.0, -2.0], [0.0, 0.02, 0.26]]]),
    )
    facts = make_exporter("spz").write(tmp_path / "one.spz", ExportItem("cup", surfel, torch.zeros(1)))
    assert facts == {"version": 3, "fractional_bits": 22, "sh_degree": 1}
    # turned about x, w is the largest in the order xyzw: place 3; then x, y and z, of which only x is not 0
    rotation = 3 << 30 | round(511 * s * math.sqrt(2)) << 20
    expected = [
        *(0x4E, 0x47, 0x53, 0x50), *(3, 0, 0, 0), *(1, 0, 0, 0), 1, 22, 0, 0,
        *(0, 0, 0x40), *(0, 0, 0x20), *(0, 0, 0xF0),
        128,
        *(128, 166, 0),
        *(128, 176, round(16 * (8 + math.log(1e-3)))),
        *rotation.to_bytes(4, "little"),
        # y, z and x of band 1: y and z are turned; steps of 8
        *(64, 160, 128), *(112, 0, 255), *(128, 128, 160),
    ]  # fmt: skip
    assert list(gzip.decompress((tmp_path / "one.spz").read_bytes())) == expected


def test_a_read_file_looks_the_same(tmp_path):
    surfels, _ = discs()
    write(tmp_path / "scene.spz", "spz", surfels)
    back = read_back(tmp_path / "scene.spz")
    for eye in ((2.0, 1.0, 1.5), (-1.0, 2.0, -0.5)):
        camera = camera_at(eye)
        before = drawn(surfels, camera)
        assert before.std() > 0.1 and psnr(before, drawn(back, camera)) > 28
    fine = {"first_band_bits": 8, "other_bands_bits": 8}
    write(tmp_path / "fine.spz", "spz", surfels, **fine)
    assert psnr(before, drawn(read_back(tmp_path / "fine.spz"), camera)) > 32


@VERSIONS
def test_the_same_bytes_again_and_much_smaller_than_a_ply(tmp_path, version):
    surfels = random_surfels(count=2000)
    write(tmp_path / "a.spz", "spz", surfels, version=version)
    write(tmp_path / "b.spz", "spz", surfels, version=version)
    write(tmp_path / "a.ply", "ply", surfels)
    assert (tmp_path / "a.spz").read_bytes() == (tmp_path / "b.spz").read_bytes()
    assert (tmp_path / "a.spz").stat().st_size * 4 < (tmp_path / "a.ply").stat().st_size


def test_no_reader_gets_an_infinite_logit(tmp_path):
    surfels = random_surfels()
    surfels.opacity_logits[:2] = torch.tensor([-20.0, 20.0])
    back = read_back(write(tmp_path / "a.spz", "spz", surfels))
    assert (255 * opacities(back.opacity_logits))[:2].round().tolist() == [1, 254]


@VERSIONS
def test_what_is_not_finite_is_left_out_and_nothing_is_a_file_too(tmp_path, version):
    surfels = random_surfels()
    surfels.means[2, 1], surfels.opacity_logits[4] = math.nan, math.inf
    write(tmp_path / "a.spz", "spz", surfels, version=version)
    assert len(read_scene(tmp_path / "a.spz").gaussians) == 5
    write(tmp_path / "none.spz", "spz", surfels[:0], version=version)
    assert len(read_scene(tmp_path / "none.spz").gaussians) == 0


@pytest.mark.parametrize(("reach", "bits"), [(0.0, 23), (0.9, 23), (1.0, 22), (2000.0, 12), (8e6, 0)])
def test_positions_get_all_the_bits_there_are(reach, bits):
    assert fractional_bits(reach) == bits
    assert round(reach * 2**bits) <= 2**23 - 1


def test_mistakes():
    with pytest.raises(UserError, match=r"reaches 1e\+07 units from the origin"):
        fractional_bits(1e7)
    with pytest.raises(UserError, match="the version of .spz is 2"):
        make_exporter("spz", version=2)
    with pytest.raises(UserError, match="first_band_bits is 9"):
        make_exporter("spz", first_band_bits=9)
