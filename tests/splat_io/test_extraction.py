"""Selection, .ply files, and the way back to the frame of the input poses."""

from __future__ import annotations

import math

import pytest
import torch
from random_surfels import a_rotation, random_surfels
from written_splats import read_ply

from beags_plugin.core.membership import Membership
from beags_plugin.core.rotations import rotation_from_quat
from beags_plugin.core.select import remove_class, select_class
from beags_plugin.core.sh import sh_colors
from beags_plugin.core.surfels import Surfels
from beags_plugin.splat_io.frames import quat_from_rotation, to_input_frame
from beags_plugin.splat_io.ply import THICKNESS, write_ply
from beags_plugin.system.errors import UserError
from beags_plugin.system.reading.ply import read_vertices

FIELDS = ("means", "quats", "log_scales", "opacity_logits", "sh")


def test_a_class_and_its_complement_are_the_whole_scene_untouched():
    surfels = random_surfels()
    ids = torch.tensor([0, 2, 1, 2, 0, 2, 1], dtype=torch.int32)
    part, index = select_class(surfels, Membership(ids), 2)
    rest, other = remove_class(surfels, Membership(ids), 2)
    assert index.tolist() == [1, 3, 5] and other.tolist() == [0, 2, 4, 6]
    for name in FIELDS:
        whole = torch.empty_like(getattr(surfels, name))
        whole[index], whole[other] = getattr(part, name), getattr(rest, name)
        assert torch.equal(whole, getattr(surfels, name))


def test_selecting_an_absent_class_gives_no_surfels():
    part, index = select_class(random_surfels(), Membership(torch.zeros(7, dtype=torch.int32)), 3)
    assert len(part) == 0 and part.sh.shape == (0, 16, 3) and index.shape == (0,)


def test_class_ids_of_another_length_are_refused():
    with pytest.raises(ValueError, match="of 7 Gaussians, not of 6"):
        select_class(random_surfels(), Membership(torch.zeros(6, dtype=torch.int32)), 0)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_ply_is_read_back_bit_for_bit(tmp_path, degree):
    surfels, ids = random_surfels(degree=degree), torch.arange(7, dtype=torch.int32)
    write_ply(tmp_path / "new folder" / "scene.ply", surfels, ids)
    read, read_ids = read_ply(tmp_path / "new folder" / "scene.ply")
    for name in ("means", "log_scales", "opacity_logits", "sh"):
        assert torch.equal(getattr(read, name), getattr(surfels, name))
    assert torch.allclose(read.quats, torch.nn.functional.normalize(surfels.quats, dim=-1), atol=1e-7)
    assert torch.equal(read_ids, ids) and read_ids.dtype == torch.int32


def test_the_columns_are_those_of_splat_viewers(tmp_path):
    surfels = random_surfels()
    write_ply(tmp_path / "scene.ply", surfels)
    vertex = read_vertices(tmp_path / "scene.ply")
    names = list(vertex.dtype.names)
    expected = ["x", "y", "z", "nx", "ny", "nz", *(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(45))]
    assert names == [*expected, "opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    # channel-major: the first 15 are red's, the 16th is green's first
    assert vertex["f_rest_0"][4] == surfels.sh[4, 1, 0].item()
    assert vertex["f_rest_14"][4] == surfels.sh[4, 15, 0].item()
    assert vertex["f_rest_15"][4] == surfels.sh[4, 1, 1].item()
    smaller = surfels.log_scales.min(dim=1).values.numpy()
    assert vertex["scale_2"] - smaller == pytest.approx(math.log(THICKNESS), abs=1e-5)
    normals = rotation_from_quat(surfels.quats)[:, :, 2]
    assert vertex["nz"] == pytest.approx(normals[:, 2].numpy(), abs=1e-6)


def test_an_empty_selection_is_still_a_ply(tmp_path):
    write_ply(tmp_path / "none.ply", random_surfels()[:0], torch.zeros(0, dtype=torch.int32))
    surfels, ids = read_ply(tmp_path / "none.ply")
    assert len(surfels) == 0 and len(ids) == 0


def test_reading_reports_what_is_wrong(tmp_path):
    with pytest.raises(UserError, match="absent.ply cannot be read"):
        read_ply(tmp_path / "absent.ply")
    (tmp_path / "text.ply").write_text("not a ply")
    with pytest.raises(UserError, match="is not a splat .ply"):
        read_ply(tmp_path / "text.ply")
    points = tmp_path / "points.ply"
    points.write_text(
        "ply\nformat ascii 1.0\nelement vertex 1\n"
        "property float x\nproperty float y\nproperty float z\nend_header\n0 0 0\n"
    )
    with pytest.raises(UserError, match="has no column 'f_dc_0'"):
        read_ply(points)


@pytest.mark.parametrize("seed", range(3))
def test_the_input_frame_undoes_the_dataparser(seed):
    """Points of each surfel, mu + s_u R[:,0] and so on, go back to where they were before x' = scale (R x + t)."""
    original = random_surfels(dtype=torch.float64)
    rotation, shift, scale = a_rotation(seed), torch.tensor([0.5, -2.0, 3.0], dtype=torch.float64), 0.37

    def points(surfels: Surfels) -> torch.Tensor:
        axes = rotation_from_quat(surfels.quats)[:, :, :2] * surfels.log_scales.exp()[:, None, :]
        return torch.cat([surfels.means[:, None], surfels.means[:, None] + axes.transpose(1, 2)], dim=1)

    moved_quats = torch.stack([quat_from_rotation(rotation @ r) for r in rotation_from_quat(original.quats)])
    moved = Surfels.of(
        scale * (original.means @ rotation.T + shift),
        moved_quats,
        original.log_scales + math.log(scale),
        original.opacity_logits,
        original.sh,
    )
    assert torch.allclose(points(moved), scale * (points(original) @ rotation.T + shift), atol=1e-12)
    back = to_input_frame(moved, torch.cat([rotation, shift[:, None]], dim=1), scale)
    assert torch.allclose(points(back), points(original), atol=1e-12)
    assert torch.equal(back.opacity_logits, original.opacity_logits)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_colours_look_the_same_from_the_same_side(degree):
    surfels = random_surfels(degree=degree, dtype=torch.float64)
    rotation, shift, scale = a_rotation(5), torch.tensor([0.1, 0.2, -0.3], dtype=torch.float64), 2.5
    turned = to_input_frame(surfels, torch.cat([rotation, shift[:, None]], dim=1), scale)
    generator = torch.Generator().manual_seed(2)
    for eye in 4 * torch.randn(6, 3, generator=generator, dtype=torch.float64):
        there = rotation.T @ (eye / scale - shift)
        before = sh_colors(surfels.sh_dc, surfels.sh_rest, surfels.means, eye, degree)
        after = sh_colors(turned.sh_dc, turned.sh_rest, turned.means, there, degree)
        assert torch.allclose(before, after, atol=1e-10)
    if degree:  # the test can tell: without turning the bands the colours differ
        assert not torch.allclose(
            before, sh_colors(surfels.sh_dc, surfels.sh_rest, turned.means, there, degree), atol=1e-3
        )


def test_the_identity_changes_nothing():
    surfels = random_surfels()
    same = to_input_frame(surfels, torch.eye(4)[:3], 1.0)
    for name in FIELDS:
        assert torch.allclose(getattr(same, name), getattr(surfels, name), atol=1e-6)
        assert getattr(same, name).dtype == torch.float32


@pytest.mark.parametrize("diagonal", [(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)])
def test_half_turns_have_quaternions_too(diagonal):
    rotation = torch.diag(torch.tensor(diagonal, dtype=torch.float64))
    assert torch.allclose(rotation_from_quat(quat_from_rotation(rotation)), rotation, atol=1e-12)


def test_a_mirror_or_a_bad_scale_is_refused():
    mirror = torch.diag(torch.tensor([1.0, 1.0, -1.0, 0.0]))[:3]
    with pytest.raises(UserError, match="not a rotation"):
        to_input_frame(random_surfels(), mirror, 1.0)
    with pytest.raises(UserError, match="scale is 0"):
        to_input_frame(random_surfels(), torch.eye(4)[:3], 0)


def test_a_ply_can_be_written_in_the_input_frame(tmp_path):
    surfels = random_surfels()
    transform = torch.cat([a_rotation(), torch.ones(3, 1, dtype=torch.float64)], dim=1)
    write_ply(tmp_path / "scene.ply", surfels, None, (transform, 0.5))
    read, ids = read_ply(tmp_path / "scene.ply")
    assert ids is None
    assert torch.allclose(read.means, to_input_frame(surfels, transform, 0.5).means)
