"""Runs that start from splat files of each format, and from files of other programs."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import replace

import numpy as np
import pytest
import torch
from random_surfels import random_surfels
from start_scenes import write_start_scene
from written_splats import write

pytest.importorskip("nerfstudio")

from test_warm_start import started

from beags_plugin.importers.base import read_scene
from beags_plugin.plugin.training.warm_start import quarter_turns
from beags_plugin.splat_io.frames import to_input_frame

C0 = 0.28209479177387814


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_start_scene(tmp_path_factory.mktemp("data"))


@pytest.mark.parametrize(
    ("kind", "name", "least"),
    [
        ("compressed-ply", "scene.compressed.ply", 38),
        ("sog", "scene.sog", 38),
        ("spz", "scene.spz", 26),
    ],
)
def test_a_run_starts_from_each_format(scene, tmp_path, capsys, kind, name, least):
    path = write(tmp_path / name, kind, scene.surfels)
    _, report = started(scene, tmp_path / "run", path)
    assert report["gaussians"] == 75 and report["psnr"] > least
    assert report["remarks"] == list(read_scene(path).remarks) and report["remarks"][0] in capsys.readouterr().out


@pytest.mark.parametrize("words", ["half a turn about x", "a quarter turn about x after half a turn about z"])
def test_a_file_with_other_axes_is_turned_until_it_fits(scene, tmp_path, capsys, words):
    """PlayCanvas' program writes .spz in the axes of .ply files, against the format's description."""
    rotation = quarter_turns()[words]
    other = to_input_frame(scene.surfels, torch.cat([rotation, torch.zeros(3, 1, dtype=torch.float64)], dim=1), 1.0)
    _, report = started(scene, tmp_path / "run", write(tmp_path / "scene.spz", "spz", other))
    assert report["psnr"] > 26 and report["turned"] == words
    assert f"fit these poses after {words}" in capsys.readouterr().out


def test_a_file_whose_axes_are_known_is_not_turned(scene, tmp_path):
    rotation = quarter_turns()["half a turn about x"]
    other = to_input_frame(scene.surfels, torch.cat([rotation, torch.zeros(3, 1, dtype=torch.float64)], dim=1), 1.0)
    _, report = started(scene, tmp_path / "run", write(tmp_path / "scene.ply", "ply", other))
    assert report["psnr"] < 20 and "turned" not in report


def test_activated_values_are_converted_and_said(scene, tmp_path, capsys):
    written = read_scene(write(tmp_path / "scene.ply", "ply", scene.surfels)).gaussians
    raw = replace(
        scene.surfels, log_scales=written.log_scales[:, :2].exp(), opacity_logits=written.opacity_logits.sigmoid()
    )
    _, report = started(scene, tmp_path / "run", write(tmp_path / "raw.ply", "ply-2dgs", raw))
    assert report["psnr"] > 45 and "are converted" in capsys.readouterr().out


def test_the_rgb_mode_of_ns_export(tmp_path):
    """The file is written by nerfstudio's own code."""
    exporter = pytest.importorskip("nerfstudio.scripts.exporter").ExportGaussianSplat
    surfels = random_surfels(count=20, degree=0)
    thin = torch.cat([surfels.log_scales, surfels.log_scales[:, :1] - 5], dim=1)
    values = torch.cat([surfels.means, surfels.opacity_logits[:, None], thin, surfels.quats], dim=1).numpy()
    names = ["x", "y", "z", "opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    table = {name: values[:, i] for i, name in enumerate(names)}
    shares = (surfels.sh_dc * C0 + 0.5).clamp(0, 1).numpy()
    rgb = {name: (255 * shares[:, i]).astype(np.uint8) for i, name in enumerate(("red", "green", "blue"))}
    normals = {name: np.zeros(20, np.float32) for name in ("nx", "ny", "nz")}
    exporter.write_ply(str(tmp_path / "splat.ply"), 20, OrderedDict({**normals, **rgb, **table}))
    found = read_scene(tmp_path / "splat.ply").gaussians
    assert torch.equal(found.means, surfels.means)
    assert np.abs((found.sh_dc.numpy() * C0 + 0.5) - shares).max() <= 1 / 255
