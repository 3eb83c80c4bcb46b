"""Compressed .ply and .sog files, read back by our readers and by PlayCanvas' own program."""

from __future__ import annotations

import io
import json
import math
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from other_programs import READ_BY_PLAYCANVAS, converted
from PIL import Image
from random_surfels import camera_at, drawn, psnr, random_surfels
from run_folders import discs
from written_splats import angles, differences, read_back
from written_splats import write as written

from beags_plugin.core.surfels import Surfels, opacities
from beags_plugin.export.base import make_exporter
from beags_plugin.export.palettes import nearest, palette_of, table_of
from beags_plugin.export.splat_values import morton_order
from beags_plugin.importers.base import read_scene
from beags_plugin.splat_io.ply import THICKNESS
from beags_plugin.surfaces.item import ExportItem, NothingToExport

SUFFIXES = {"compressed-ply": "compressed.ply", "sog": "sog"}
FORMATS = pytest.mark.parametrize("kind", SUFFIXES)


def write(folder: Path, kind: str, surfels: Surfels, stem: str = "cup") -> Path:
    return written(folder / f"{stem}.{SUFFIXES[kind]}", kind, surfels)


def in_order(surfels: Surfels) -> Surfels:
    """The surfels in the files' order."""
    return surfels[torch.from_numpy(morton_order(surfels.means.double().numpy()))]


@FORMATS
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_every_parameter_comes_back_as_exactly_as_the_format_allows(tmp_path, kind, degree):
    surfels = in_order(random_surfels(count=600, degree=degree))
    path = write(tmp_path, kind, surfels)
    back = read_back(path)
    assert back.sh_degree == degree and len(back) == 600
    # 11 bits (10 of y) of the box of 256 neighbours; 16 bits of logarithms
    step = {"compressed-ply": 0.5 * 8 / 1023, "sog": 1e-4}[kind]
    assert (back.means - surfels.means).abs().max() <= step
    step = {"compressed-ply": 0.5 * 7 / 1023, "sog": 0.3}[kind]  # the rarest scales are the least exact in a table
    errors = (back.log_scales - surfels.log_scales).abs()
    assert errors.max() <= step and errors.mean() < 0.01
    assert (opacities(back.opacity_logits) - opacities(surfels.opacity_logits)).abs().max() <= 0.5 / 255 + 1e-5
    errors = (back.sh_dc - surfels.sh_dc).abs()
    assert errors.mean() < 0.008 and errors.max() <= {"compressed-ply": 0.5 * 1.6 / 255, "sog": 0.04}[kind] / 0.282
    assert angles(back.quats, surfels.quats).max() < {"compressed-ply": 0.3, "sog": 1.2}[kind]
    if degree:
        errors = (back.sh_rest - surfels.sh_rest).abs()
        assert errors.max() <= {"compressed-ply": 1 / 64 + 1e-5, "sog": 0.2}[kind] and errors.mean() < 0.01
    thin = surfels.log_scales.min(dim=1).values.numpy() + math.log(THICKNESS)
    path.write_bytes(without_tag(path))
    thirds = read_scene(path).gaussians.log_scales[:, 2]
    assert np.abs(thirds.numpy() - thin).max() <= 0.3


def without_tag(path: Path) -> bytes:
    """A file that does not say that its Gaussians are discs: its third scales are read too."""
    if path.suffix == ".ply":
        return path.read_bytes().replace(b"comment SplatRenderMode: 2dgs\n", b"")
    content = io.BytesIO()
    with zipfile.ZipFile(path) as archive, zipfile.ZipFile(content, "w") as bare:
        for name in archive.namelist():
            data = archive.read(name)
            bare.writestr(name, data.replace(b'"model": "2dgs", ', b"") if name == "meta.json" else data)
    return content.getvalue()


@FORMATS
def test_a_file_says_that_its_gaussians_are_discs(tmp_path, kind):
    path = write(tmp_path, kind, random_surfels(count=30))
    assert read_scene(path).gaussians.log_scales.shape == (30, 2)
    path.write_bytes(without_tag(path))
    assert read_scene(path).gaussians.log_scales.shape == (30, 3)


@READ_BY_PLAYCANVAS
@pytest.mark.parametrize("name", ["cup.2dgs.ply", "cup.compressed.ply", "cup.sog"])
def test_playcanvas_knows_that_they_are_discs(tmp_path, name):
    """From version 3.4 on, splat-transform writes discs that it knows as a .ply with two scales, and says so."""
    kind = {"cup.2dgs.ply": "ply-2dgs", "cup.sog": "sog"}.get(name, "compressed-ply")
    surfels = random_surfels(count=300)
    back = converted(written(tmp_path / name, kind, surfels), tmp_path / "back.ply")
    if b"SplatRenderMode" not in back.read_bytes()[:500]:
        pytest.skip("this splat-transform is older than the tag")
    assert b"scale_2" not in back.read_bytes()[:5000]
    assert read_scene(back).gaussians.log_scales.shape == (300, 2)


@FORMATS
def test_what_lies_at_the_ends_of_a_range_is_exact(tmp_path, kind):
    """One Gaussian is its own box: nothing is lost but what bytes cannot hold."""
    surfels = random_surfels(count=1)
    back = read_back(write(tmp_path, kind, surfels))
    assert torch.allclose(back.means, surfels.means, atol=1e-6)
    assert torch.allclose(back.log_scales, surfels.log_scales, atol=1e-6)
    assert torch.allclose(back.sh_dc, surfels.sh_dc, atol=1e-6)


@FORMATS
def test_a_read_file_looks_the_same(tmp_path, kind):
    surfels, _ = discs()
    back = read_back(write(tmp_path, kind, surfels))
    for eye in ((2.0, 1.0, 1.5), (-1.0, 2.0, -0.5)):
        camera = camera_at(eye)
        before = drawn(surfels, camera)
        assert before.std() > 0.1 and psnr(before, drawn(back, camera)) > 38


@FORMATS
def test_the_same_bytes_again_and_much_smaller_than_a_ply(tmp_path, kind):
    surfels = random_surfels(count=3000)
    first, again = write(tmp_path, kind, surfels, "a"), write(tmp_path, kind, surfels, "b")
    assert first.read_bytes() == again.read_bytes()
    make_exporter("ply").write(tmp_path / "a.ply", ExportItem("cup", surfels, torch.zeros(3000, dtype=torch.int32)))
    assert first.stat().st_size * 3.5 < (tmp_path / "a.ply").stat().st_size


@FORMATS
def test_no_reader_gets_an_infinite_logit(tmp_path, kind):
    surfels = random_surfels()
    surfels.opacity_logits[:2] = torch.tensor([-20.0, 20.0])
    alphas = 255 * opacities(read_back(write(tmp_path, kind, surfels)).opacity_logits)
    assert alphas.min().round() == 1 and alphas.max().round() == 254


@FORMATS
def test_what_is_not_finite_is_left_out_and_nothing_is_a_sentence(tmp_path, kind):
    surfels = random_surfels()
    surfels.means[2, 1], surfels.opacity_logits[4] = math.nan, math.inf
    assert len(read_back(write(tmp_path, kind, surfels))) == 5
    with pytest.raises(NothingToExport, match="cup has no finite Gaussian"):
        write(tmp_path, kind, surfels[:0], "none")
    assert [path.name for path in tmp_path.iterdir()] == [f"cup.{SUFFIXES[kind]}"]


def test_a_known_gaussian_has_known_words_in_a_compressed_ply(tmp_path):
    """The words are by hand, from the description: two Gaussians at the ends of the chunk's ranges, one between."""
    s = math.sqrt(0.5)
    surfels = Surfels(
        torch.tensor([[0.0, 0.0, 0.0], [1.0, 2.0, 4.0], [0.5, 1.0, 1.0]]),
        torch.tensor([[s, s, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [-0.8, 0.0, 0.0, 0.6]]),
        torch.tensor([[-3.0, -3.0], [-1.0, -1.0], [-2.0, -1.0]]),
        torch.tensor([0.0, 20.0, -20.0]),
        torch.tensor([[0.0, 0.0, 0.0], [1.0, 2.0, 3.0], [0.25, 1.0, 3.0]]),
        torch.zeros(3, 0, 3),
    )
    data = write(tmp_path, "compressed-ply", surfels).read_bytes()
    body = data[data.index(b"end_header\n") + 11 :]
    chunk = np.frombuffer(body, "<f4", 18)
    thin = math.log(THICKNESS)
    c0 = 0.28209479
    assert chunk[:12] == pytest.approx([0, 0, 0, 1, 2, 4, -3, -3, -3 + thin, -1, -1, -1 + thin])
    assert chunk[12:] == pytest.approx([0.5, 0.5, 0.5, 0.5 + c0, 0.5 + 2 * c0, 0.5 + 3 * c0])
    words = np.frombuffer(body, "<u4", 12, 72).reshape(3, 4)
    assert len(body) == 72 + 48
    middle = next(row for row in words if row[0] not in (0, 0xFFFFFFFF))  # the Morton curve has it between the others
    x, y, z = 1024, 512, 512  # halves and a quarter of 2047, 1023, 2047, rounded to even
    assert middle[0] == x << 21 | y << 11 | z
    # w = 0.8 is left out, z = -0.6 after the change of sign: (-0.6 * sqrt(2) / 2 + 0.5) * 1023 = 77.5
    assert middle[1] in (512 << 20 | 512 << 10 | last for last in (77, 78))
    assert middle[2] in (1024 << 21 | 1023 << 11 | half for half in (1023, 1024))  # thin scales are no round numbers
    assert middle[3] == 64 << 24 | 128 << 16 | 255 << 8 | 1
    second = words[words[:, 0] == 0xFFFFFFFF][0]
    assert second[1] >> 30 == 2 and second[3] & 255 == 254


def test_the_files_of_a_sog(tmp_path):
    facts = make_exporter("sog").write(
        tmp_path / "cup.sog", ExportItem("cup", random_surfels(count=70), torch.zeros(70, dtype=torch.int32))
    )
    assert facts == {"version": 2, "sh_degree": 3, "palette": 70}
    with zipfile.ZipFile(tmp_path / "cup.sog") as archive:
        meta = json.loads(archive.read("meta.json"))
        sizes = {name: Image.open(io.BytesIO(archive.read(name))).size for name in archive.namelist()[:-1]}
        assert all(archive.read(name)[12:16] == b"VP8L" for name in sizes)  # lossless
    assert meta["version"] == 2 and meta["count"] == 70 and meta["shN"]["bands"] == 3
    assert sizes.pop("shN_centroids.webp") == (64 * 15, 2)
    assert set(sizes.values()) == {(12, 6)} and len(sizes) == 6
    assert all(len(meta[name]["codebook"]) == 256 for name in ("scales", "sh0", "shN"))


def test_colours_of_transparent_gaussians_stay(tmp_path):
    """Lossless WebP may drop what stands under an alpha of 0 or near it; the codes must not change."""
    surfels = random_surfels(count=300)
    surfels.opacity_logits[:] = -20.0
    back = read_back(write(tmp_path, "sog", surfels))
    assert (back.sh_dc - in_order(surfels).sh_dc).abs().mean() < 0.005


@pytest.mark.slow("clusters 65,000 colours")
def test_many_gaussians_share_a_palette(tmp_path):
    """Above 1,024 Gaussians the higher bands are clustered: four Gaussians an entry."""
    near = random_surfels(count=8000, degree=1)
    kinds = torch.arange(8000) % 50
    near = Surfels(near.means, near.quats, near.log_scales, near.opacity_logits, near.sh_dc, near.sh_rest[kinds])
    item = ExportItem("cup", near, torch.zeros(8000, dtype=torch.int32))
    assert make_exporter("sog").write(tmp_path / "a.sog", item)["palette"] == 2000
    back = read_back(tmp_path / "a.sog")
    assert (back.sh_rest - in_order(near).sh_rest).abs().max() < 0.02  # 50 kinds find their entries


def test_tables_of_numbers():
    generator = np.random.default_rng(0)
    values = np.concatenate([generator.normal(size=20000), [40.0]])
    table = table_of(values, 256)
    errors = np.abs(table[nearest(table, values)] - values)
    assert (np.diff(table) >= 0).all() and errors[-1] == 0
    # equal parts of the range from -4 to 4 would be wrong by 8 / 256 / 4 on average
    assert errors.mean() < 0.008
    few = table_of(np.array([3.0, 1.0, 3.0]), 4)
    assert few.tolist() == [1.0, 3.0, 3.0, 3.0] and nearest(few, np.array([0.9, 5.0])).tolist()[0] == 0


@pytest.mark.slow("clusters 65,000 colours")
def test_a_palette_is_the_same_on_any_number_of_threads(tmp_path):
    vectors = np.random.default_rng(0).normal(size=(3000, 9))
    np.save(tmp_path / "v.npy", vectors)
    script = (
        "import sys, numpy as np; from beags_plugin.export.palettes import palette_of;"
        "p, l = palette_of(np.load(sys.argv[1])); np.savez(sys.argv[2], p=p, l=l)"
    )
    for threads in ("1", "3"):
        environment = {**os.environ, "OMP_NUM_THREADS": threads, "OPENBLAS_NUM_THREADS": threads}
        subprocess.run(
            [sys.executable, "-c", script, tmp_path / "v.npy", tmp_path / f"{threads}.npz"], check=True, env=environment
        )
    one, three = (np.load(tmp_path / f"{threads}.npz") for threads in ("1", "3"))
    assert (one["p"] == three["p"]).all() and (one["l"] == three["l"]).all()
    palette, labels = palette_of(vectors[:1000])
    assert (palette[labels] == vectors[:1000]).all()


def test_neighbours_come_one_after_another():
    grid = np.stack(np.meshgrid(*[np.arange(4.0)] * 3), axis=-1).reshape(-1, 3)
    ordered = grid[morton_order(grid)]
    for cells in ordered.reshape(8, 8, 3):  # each eight fill a cube of two
        assert (np.ptp(cells, axis=0) == 1).all()


def read_by_both(path: Path) -> dict[str, float]:
    """The greatest differences between what our reader and splat-transform read."""
    theirs = converted(path, path.with_name("back.ply"))
    return differences(read_scene(path).gaussians, read_scene(theirs).gaussians)


@READ_BY_PLAYCANVAS
@FORMATS
@pytest.mark.parametrize("degree", [0, 3])
def test_playcanvas_reads_the_same(tmp_path, kind, degree):
    surfels = random_surfels(count=600, degree=degree)
    path = write(tmp_path, kind, surfels)
    found = read_by_both(path)
    assert max(found.values()) < 1e-3, found


@READ_BY_PLAYCANVAS
@FORMATS
def test_what_playcanvas_writes_is_read_the_same(tmp_path, kind):
    """Checks our readers, which the other tests trust, with files that we did not write."""
    surfels = random_surfels(count=600)
    path = converted(written(tmp_path / "cup.ply", "ply", surfels), tmp_path / f"theirs.{SUFFIXES[kind]}")
    found = read_by_both(path)
    assert max(found.values()) < 1e-3, found
