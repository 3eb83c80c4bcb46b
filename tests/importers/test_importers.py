"""Scenes to start from: what is read, what is dropped, and what is refused before its size is allocated."""

from __future__ import annotations

import math
import pickle

import numpy as np
import pytest
import torch
from random_surfels import a_rotation, random_surfels
from start_scenes import a_frame, in_frame, write_splatfacto

from beags_plugin.core.flattening import Gaussians, flatten, flattening, without_empty_bands
from beags_plugin.core.rotations import rotation_from_quat
from beags_plugin.core.sh import sh_colors
from beags_plugin.core.surfels import Surfels
from beags_plugin.importers import IMPORTERS
from beags_plugin.importers.base import find_importer
from beags_plugin.importers.checkpoint import CheckpointImporter
from beags_plugin.importers.ply import PlyImporter
from beags_plugin.splat_io.frames import from_input_frame, to_input_frame
from beags_plugin.splat_io.ply import write_ply
from beags_plugin.splat_io.splat_file import read_splat_file
from beags_plugin.system.errors import UserError
from beags_plugin.system.reading.ply import read_vertices, write_vertices
from beags_plugin.system.reading.tensors import load_tensors


def gaussians(count: int = 40, seed: int = 0) -> Gaussians:
    g = torch.Generator().manual_seed(seed)
    return Gaussians(
        torch.randn(count, 3, generator=g),
        torch.randn(count, 4, generator=g),
        torch.randn(count, 3, generator=g),
        torch.randn(count, generator=g),
        torch.randn(count, 3, generator=g),
        torch.randn(count, 8, 3, generator=g),
    )


# -- flattening --------------------------------------------------------------------------------------------------------


def test_flattening_takes_the_smallest_part_of_the_covariance_and_nothing_else():
    given = gaussians()
    surfels, lost = flatten(given)
    axes, scales = rotation_from_quat(given.quats.double()), given.log_scales.double().exp()
    covariance = axes @ torch.diag_embed(scales.square()) @ axes.transpose(1, 2)
    values, vectors = torch.linalg.eigh(covariance)  # ascending
    without = covariance - values[:, :1, None] * vectors[:, :, :1] @ vectors[:, :, :1].transpose(1, 2)
    turned, kept = rotation_from_quat(surfels.quats.double()), surfels.log_scales.double().exp()
    flat = turned[:, :, :2] @ torch.diag_embed(kept.square()) @ turned[:, :, :2].transpose(1, 2)
    assert torch.allclose(flat, without, atol=1e-5 * float(covariance.abs().max()))
    ratio = (values[:, 0] / values[:, 1]).sqrt()
    assert lost is not None and lost.median_ratio == pytest.approx(float(ratio.median()), rel=1e-4)
    assert lost.round_share == pytest.approx(float((ratio > 0.5).double().mean()))


def test_surfels_and_gaussians_thin_along_the_third_axis_keep_their_numbers():
    surfels = random_surfels()
    flat = Gaussians(
        surfels.means, surfels.quats, surfels.log_scales, surfels.opacity_logits, surfels.sh_dc, surfels.sh_rest
    )
    thin = torch.cat([flat.log_scales, flat.log_scales.amin(1, keepdim=True) - 3], dim=1)
    for given in (flat, Gaussians(**{**vars(flat), "log_scales": thin})):
        kept, _ = flatten(given)
        assert torch.equal(kept.quats, surfels.quats) and torch.equal(kept.log_scales, surfels.log_scales)
    assert flatten(flat)[1] is None and flattening(thin[:0]) is None
    assert flattening(thin).median_ratio == pytest.approx(math.exp(-3))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_degrees_that_are_padding_are_left_out(degree):
    surfels = random_surfels(degree=degree)
    padded = Surfels(**{**vars(surfels), "sh_rest": torch.zeros(7, 15, 3)})
    padded.sh_rest[:, : surfels.sh_rest.shape[1]] = surfels.sh_rest
    assert torch.equal(without_empty_bands(padded).sh_rest, surfels.sh_rest)


def test_a_sphere_keeps_its_axes():
    given = gaussians(3)
    ball = Gaussians(**{**vars(given), "log_scales": torch.zeros(3, 3)})
    surfels, lost = flatten(ball)
    assert torch.equal(surfels.quats, ball.quats) and lost.median_ratio == 1.0 and lost.round_share == 1.0


def test_odd_values_are_recognised():
    given = gaussians(6)
    given.means[0, 1], given.sh_rest[1, 3, 2], given.log_scales[2, 0] = torch.nan, torch.inf, -torch.inf
    given.quats[3] = 0.0
    given.opacity_logits[4] = torch.inf  # converters write this for "opaque"
    assert given.usable().tolist() == [False, False, False, False, True, True]
    assert flatten(given)[0].opacity_logits[4] == 30.0


# -- frames ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_the_colour_of_a_moved_scene_is_what_it_was_from_every_side(degree):
    """A camera moves along; in float64 the turned bands are exact."""
    surfels = random_surfels(degree=degree, dtype=torch.float64)
    rotation, shift, scale = a_rotation(degree), torch.tensor([0.5, -2.0, 3.0], dtype=torch.float64), 0.37
    moved = from_input_frame(surfels, torch.cat([rotation, shift[:, None]], dim=1), scale)
    eyes = 5 * torch.randn(20, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    for eye in eyes:
        before = sh_colors(surfels.sh_dc, surfels.sh_rest, surfels.means, eye, degree)
        after = sh_colors(moved.sh_dc, moved.sh_rest, moved.means, scale * (rotation @ eye + shift), degree)
        assert torch.allclose(before, after, atol=1e-9)
    rounded = Surfels(**{name: value.float() for name, value in vars(surfels).items()})
    single = from_input_frame(rounded, torch.cat([rotation, shift[:, None]], dim=1), scale)
    assert torch.allclose(single.sh, moved.sh.float(), atol=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_to_and_from_the_input_frame_undo_each_other(seed):
    frame, surfels = a_frame(seed, 0.4), random_surfels(dtype=torch.float64)
    back = to_input_frame(from_input_frame(surfels, *frame), *frame)
    for name in ("means", "log_scales", "opacity_logits", "sh"):
        assert torch.allclose(getattr(back, name), getattr(surfels, name), atol=1e-12)
    assert torch.allclose(rotation_from_quat(back.quats), rotation_from_quat(surfels.quats), atol=1e-12)


# -- .ply --------------------------------------------------------------------------------------------------------------


def header(count: int, *columns: str, form: str = "binary_little_endian") -> bytes:
    lines = ["ply", f"format {form} 1.0", f"element vertex {count}", *(f"property {column}" for column in columns)]
    return "\n".join([*lines, "end_header", ""]).encode()


FLAT = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", *(f"rot_{i}" for i in range(4))]


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (header(10**12, *(f"float {n}" for n in FLAT)) + bytes(52), "promises 52000000000000 bytes, but 52 follow"),
        (header(2, *(f"float {n}" for n in FLAT)) + bytes(103), "is cut off or damaged"),
        (header(10**9, *(f"float {n}" for n in FLAT), form="ascii") + b"0 0 0\n", "is cut off or damaged"),
        (header(10**9, "list uchar float x") + bytes(9), "is cut off or damaged"),
        (header(-1, *(f"float {n}" for n in FLAT)), "promises -1 vertex elements"),
        (header(1, *(f"float {n}" for n in FLAT[:-1])) + bytes(48), "no column 'rot_3'"),
        (header(1, *(f"float {n}" for n in FLAT[1:]), "list uchar float x") + bytes(49), "no column 'x'"),
        (header(1, *(f"float {n}" for n in FLAT), "float f_rest_0") + bytes(56), "has 1 f_rest columns"),
        (header(1, *(f"float {n}" for n in FLAT), *9 * ["float f_rest_x"]) + bytes(88), "is not a splat .ply"),
        (b"ply\nformat binary_little_endian 1.0\nelement vertex many\nend_header\n", "is not a splat .ply"),
        (b"ply\nno end", "does not start with a .ply header"),
        (b"", "it is empty, as after a download that broke off"),
    ],
)
def test_a_damaged_ply_is_refused_in_one_sentence(tmp_path, content, words):
    path = tmp_path / "scene.ply"
    path.write_bytes(content)
    with pytest.raises(UserError) as error:
        read_splat_file(path)
    assert words in str(error.value) and "\n" not in str(error.value)


def test_text_and_doubles_are_read_too(tmp_path):
    surfels = random_surfels(degree=1)
    write_ply(tmp_path / "binary.ply", surfels)
    data = read_vertices(tmp_path / "binary.ply")
    with open(tmp_path / "double.ply", "wb") as file:
        write_vertices(file, data.astype([(column, "<f8") for column in data.dtype.names]))
    header = (tmp_path / "binary.ply").read_bytes().partition(b"end_header\n")[0].decode("ascii")
    rows = "\n".join(" ".join(repr(float(value)) for value in row) for row in data.tolist())
    (tmp_path / "text.ply").write_text(header.replace("binary_little_endian", "ascii") + "end_header\n" + rows)
    for name in ("text", "double"):
        read = read_splat_file(tmp_path / f"{name}.ply").gaussians
        assert torch.allclose(read.means, surfels.means) and torch.allclose(read.sh_rest, surfels.sh_rest)
        assert read.log_scales.shape == (7, 3)


# -- checkpoints -------------------------------------------------------------------------------------------------------


def checkpoint(tmp_path, **changes) -> tuple[object, object]:
    run = write_splatfacto(tmp_path / "run", random_surfels(), a_frame(1, 0.5))
    file = next(run.rglob("*.ckpt"))
    content = load_tensors(file)
    for name, value in changes.items():
        content["pipeline"][f"_model.gauss_params.{name}"] = value
        if value is None:
            del content["pipeline"][f"_model.gauss_params.{name}"]
    torch.save(content, file)
    return run, file


def test_a_checkpoint_is_found_by_its_run_its_folder_and_its_name(tmp_path):
    run, file = checkpoint(tmp_path)
    (run / "config.yml").write_text("")
    expected, frame = random_surfels(), a_frame(1, 0.5)
    for path in (run, run / "config.yml", file.parent, file):
        assert isinstance(find_importer(path), CheckpointImporter)
        scene = CheckpointImporter().read(path)
        assert scene.kind == "run of splatfacto" and not scene.note
        assert torch.equal(scene.gaussians.means, expected.means)
        assert torch.equal(scene.normalization[0], frame[0]) and scene.normalization[1] == 0.5
    (run / "dataparser_transforms.json").unlink()
    scene = CheckpointImporter().read(run)
    assert scene.normalization is None and "is missing" in scene.note


def test_the_newest_checkpoint_counts(tmp_path):
    run, file = checkpoint(tmp_path)
    newer = load_tensors(file)
    newer["pipeline"]["_model.gauss_params.means"] += 1
    torch.save(newer, file.with_name("step-000000100.ckpt"))
    assert torch.equal(CheckpointImporter().read(run).gaussians.means, random_surfels().means + 1)


def test_colours_of_splatfacto_without_bands_are_logits(tmp_path):
    _, file = checkpoint(tmp_path, features_rest=torch.zeros(7, 0, 3), features_dc=torch.tensor([[0.3, -2.0, 4.0]] * 7))
    read = CheckpointImporter().read(file).gaussians
    shown = sh_colors(read.sh_dc, read.sh_rest, read.means, torch.zeros(3), 0)
    assert torch.allclose(shown, torch.sigmoid(torch.tensor([0.3, -2.0, 4.0])).expand(7, 3), atol=1e-6)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"means": None}, "has no gauss_params.means"),
        ({"quats": torch.zeros(6, 4)}, "gauss_params.quats is [6, 4]"),
        ({"scales": torch.zeros(7, 4)}, "gauss_params.scales is [7, 4]"),
        ({"features_rest": torch.zeros(7, 4, 3)}, "gauss_params.features_rest is [7, 4, 3]"),
        ({"opacities": torch.tensor(1.0)}, "gauss_params.opacities is []"),
        ({"opacities": torch.zeros(7, 1, dtype=torch.int64)}, "has no gauss_params.opacities"),
    ],
)
def test_a_checkpoint_of_something_else_is_refused(tmp_path, changes, words):
    _, file = checkpoint(tmp_path, **changes)
    with pytest.raises(UserError) as error:
        CheckpointImporter().read(file)
    assert words in str(error.value)


def test_few_numbers_that_claim_to_be_many_are_not_copied(tmp_path):
    many, count = torch.zeros(1), 10**10
    shapes = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": (1,), "features_dc": (3,)}
    changes = {name: many.expand(count, *shape) for name, shape in shapes.items()}
    _, file = checkpoint(tmp_path, **changes, features_rest=many.expand(count, 0, 3))
    with pytest.raises(UserError, match="is larger than the file"):
        CheckpointImporter().read(file)


class Evil:
    def __reduce__(self):
        return (print, ("this must not be printed",))


def test_a_checkpoint_is_data_not_code(tmp_path, capsys):
    _, file = checkpoint(tmp_path)
    for write in (
        lambda: torch.save({"pipeline": Evil()}, file),
        lambda: file.write_bytes(pickle.dumps(Evil())),
        lambda: file.write_bytes(b"PK\x03\x04 nothing"),
        lambda: file.write_bytes(b""),
        lambda: torch.save([1, 2], file),
    ):
        write()
        with pytest.raises(UserError, match="is not a checkpoint of nerfstudio"):
            CheckpointImporter().read(file)
    assert "must not be printed" not in capsys.readouterr().out


def test_the_transform_of_a_run_is_checked(tmp_path):
    run, _ = checkpoint(tmp_path)
    for content in ("{}", "nonsense", '{"transform": [[1, 2], [3, 4]], "scale": 1}'):
        (run / "dataparser_transforms.json").write_text(content)
        with pytest.raises(UserError, match="dataparser_transforms.json cannot be read"):
            CheckpointImporter().read(run)


# -- choosing ----------------------------------------------------------------------------------------------------------


def test_importers_are_chosen_by_what_the_file_is(tmp_path):
    assert {"checkpoint", "ply", "compressed-ply", "spz", "splat", "sog"} <= set(IMPORTERS.names())
    write_ply(tmp_path / "scene.PLY", random_surfels())
    assert isinstance(find_importer(tmp_path / "scene.PLY"), PlyImporter)
    for name, words in (("scene.obj", "is nothing to start from: name one of these"), ("a.ksplat", "convert it first")):
        (tmp_path / name).touch()
        with pytest.raises(UserError, match=words):
            find_importer(tmp_path / name)
    with pytest.raises(UserError, match="holds no checkpoint"):
        CheckpointImporter().read(tmp_path)


def test_gaussians_with_volume_keep_what_is_in_the_file(tmp_path):
    moved = in_frame(random_surfels(), a_frame(3))
    write_ply(tmp_path / "scene.ply", moved)
    scene = PlyImporter().read(tmp_path / "scene.ply")
    assert scene.kind == "3DGS .ply" and scene.normalization is None
    surfels, lost = flatten(scene.gaussians)
    assert isinstance(surfels, Surfels) and lost.median_ratio == pytest.approx(1e-3, rel=1e-3)
    assert np.array_equal(surfels.sh.numpy(), moved.sh.numpy())
