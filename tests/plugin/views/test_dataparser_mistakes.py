"""Data that cannot be read are described in one sentence; the parser loads without a data manager."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from data_folders import (
    noise,
    write_colmap,
    write_transforms,
)
from parsed_views import parse
from PIL import Image

from beags_plugin.plugin.views.dataparser import BeagsDataParserConfig
from beags_plugin.system.errors import UserError

# --- mistakes -----------------------------------------------------------------------------------------------------


def edit(root: Path, change) -> None:
    meta = json.loads((root / "transforms.json").read_text())
    change(meta)
    (root / "transforms.json").write_text(json.dumps(meta))


MISTAKES = {  # others are in tests/mistakes
    "mirrored": (lambda root: edit(root, lambda m: mirror(m["frames"][0])), "not a rotation and a translation"),
    "k4": (lambda root: edit(root, lambda m: m.update(k4=0.1)), "k4 != 0"),
    "two images of one name": (
        lambda root: [
            Image.fromarray(noise(3)).save(root / "images/v01.jpg"),
            edit(root, lambda meta: meta["frames"][0].update(file_path="images/v01.jpg")),
        ],
        "v01.jpg and .*v01.png are both called v01, by which their masks are found: rename one of them, in the poses",
    ),
    "two copies of one image": (
        lambda root: [
            (root / "transforms.json").unlink(),
            write_colmap(root, names=["v00.png", "v01.png", "v02.png"]),
            (root / "images/v01.png").rename(root / "images/v01.bmp"),
            (root / "images/v02.png").rename(root / "images/v01.webp"),
        ],
        r"v01.png does not exist, and .*v01.bmp or .*v01.webp could stand for it: remove one of them",
    ),
}


def mirror(frame) -> None:
    for row in frame["transform_matrix"][:3]:
        row[0] = -row[0]


@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistakes_are_described_in_one_sentence(tmp_path, mistake):
    write_transforms(tmp_path)
    make, message = MISTAKES[mistake]
    make(tmp_path)
    parser = BeagsDataParserConfig(data=tmp_path).setup()
    with pytest.raises(UserError, match=message) as raised:
        for split in ("train", "val"):
            parser.get_dataparser_outputs(split)
    assert "\n" not in str(raised.value)


def test_wrong_options(tmp_path):
    write_transforms(tmp_path)
    with pytest.raises(UserError, match="downscale_factor is nan"):
        parse(tmp_path, downscale_factor=float("nan"))
    with pytest.raises(UserError, match="no COLMAP model"):
        parse(tmp_path, layout="colmap")
