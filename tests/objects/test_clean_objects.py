"""``beags extract`` and ``beags export`` leave out what does not belong to an object."""

from __future__ import annotations

import json
import shutil

import pytest
import torch
from run_folders import (
    discs,
    drawn_labels,
    ring_cameras,
    state_of,
    write_camera_path,
    write_drawn_scene,
    write_trained,
)

pytest.importorskip("nerfstudio")

from written_splats import read_ply

from beags_plugin.commands.cli import main
from beags_plugin.core.surfels import Surfels
from beags_plugin.labels.classes import write_mask
from beags_plugin.runs.belonging import Belonging
from beags_plugin.runs.relocation import open_run
from beags_plugin.runs.run import Run
from beags_plugin.runs.write import write_run

CHIP = 3  # discs


@pytest.fixture
def trained(tmp_path):
    """A run of the drawn discs, whose cup has a chip that floats above all of them."""
    write_drawn_scene(tmp_path / "lab")
    config_path = write_trained(tmp_path / "run", tmp_path / "lab")
    surfels, class_ids = discs()
    chip = surfels[:CHIP]
    means = torch.tensor([0.0, 0.0, 0.75]) + 0.02 * torch.arange(CHIP)[:, None]
    chip = Surfels(means, chip.quats, chip.log_scales - 1, chip.opacity_logits, chip.sh_dc, chip.sh_rest)
    both = Surfels.of(*(torch.cat([getattr(each, name) for each in (surfels, chip)]) for name in
                        ("means", "quats", "log_scales", "opacity_logits", "sh")))  # fmt: skip
    ids = torch.cat([class_ids, torch.ones(CHIP, dtype=torch.int32)])
    write_run(open_run(config_path), tmp_path / "run", state_of(both, ids), 299)
    masks = tmp_path / "run/prepared/masks"
    masks.mkdir(parents=True)
    for index, camera in enumerate(ring_cameras(9, 4)):
        write_mask(masks / f"v{index:02d}.png", drawn_labels(camera).numpy().astype("uint16"))
    torch.save({}, masks.parent / "grid.pt")
    return config_path


def extracted(config, output, *options, name="cup"):
    main(["extract", "--load-config", str(config), "--object", name, "--output", str(output), *options])
    return read_ply(output / name / f"{name}.ply")[0]


def test_the_chip_is_left_out_unless_all_is_kept(trained, tmp_path, capsys):
    cup = extracted(trained, tmp_path / "clean", "--json", str(tmp_path / "done.json"))
    assert len(cup) == 25 and float(cup.means[:, 2].max()) < 0.7
    assert "cup: 25 Gaussians; 3 that reach outside its masks left out" in capsys.readouterr().out
    left_out = {"outside": 3, "loose": 0, "doubt": ""}
    assert json.loads((tmp_path / "done.json").read_text())[0]["left_out"] == left_out
    assert json.loads((tmp_path / "clean/cup/extraction.json").read_text())["left_out"] == left_out
    assert len(extracted(trained, tmp_path / "all", "--keep-all")) == 25 + CHIP
    assert "cup: 28 Gaussians\n" in capsys.readouterr().out
    main(["extract", "--load-config", str(trained), "--object", "cup", "--remove", "--output", str(tmp_path / "rest")])
    assert len(read_ply(tmp_path / "rest/without_cup/without_cup.ply")[0]) == 50  # the chip goes with its object
    again = extracted(tmp_path / "all/cup/config.yml", tmp_path / "again")
    assert len(again) == 25 + CHIP and "as the run is part of a scene" in capsys.readouterr().out


def test_export_leaves_out_the_same(trained, tmp_path, capsys):
    extracted(trained, tmp_path / "runs")
    capsys.readouterr()
    arguments = ["export", "--load-config", str(trained), "--all", "--output"]
    main([*arguments, str(tmp_path / "files")])
    printed = capsys.readouterr().out
    assert "cup: 25 Gaussians; 3 that reach outside its masks left out" in printed
    assert "box: 25 Gaussians; nothing left out" in printed and "background: 25 Gaussians\n" in printed
    assert (tmp_path / "files/cup.ply").read_bytes() == (tmp_path / "runs/cup/cup.ply").read_bytes()
    manifest = json.loads((tmp_path / "files/manifest.json").read_text())
    counts = {each["name"]: each.get("left_out_gaussians", {}).get("outside") for each in manifest["objects"]}
    assert counts == {"background": None, "cup": 3, "box": 0}
    main([*arguments, str(tmp_path / "all"), "--keep-all"])
    assert len(read_ply(tmp_path / "all/cup.ply")[0]) == 25 + CHIP


def test_a_film_along_a_camera_path_leaves_out_the_same_also_with_moved_photos(trained, tmp_path):
    (tmp_path / "lab").rename(tmp_path / "moved")
    path = write_camera_path(tmp_path / "flight.json")
    main(["render", "--load-config", str(trained), "--camera-path", str(path), "--object", "cup",
          "--data", str(tmp_path / "moved"), "--output", str(tmp_path / "flight.gif")])  # fmt: skip
    assert (tmp_path / "flight.gif").exists()
    dropped, _ = Belonging(Run(trained).scene, trained.parent).known(1)
    assert dropped.tolist() == [75, 76, 77]


def test_without_masks_or_data_nothing_is_left_out_and_the_line_says_so(trained, tmp_path, capsys):
    (tmp_path / "lab").rename(tmp_path / "moved")
    assert len(extracted(trained, tmp_path / "gone")) == 25 + CHIP
    assert "nothing left out, as the run's data cannot be read (--data names their folder)" in capsys.readouterr().out
    assert len(extracted(trained, tmp_path / "found", "--data", str(tmp_path / "moved"))) == 25
    (trained.parent / "prepared/masks/v03.png").unlink()
    assert len(extracted(trained, tmp_path / "fewer", "--data", str(tmp_path / "moved"))) == 25 + CHIP
    assert "nothing left out, as the masks saved in the run do not fit its data" in capsys.readouterr().out
    shutil.rmtree(trained.parent / "prepared")
    assert len(extracted(trained, tmp_path / "none", "--data", str(tmp_path / "moved"))) == 25 + CHIP
    assert "nothing left out, as the run has no saved masks" in capsys.readouterr().out
