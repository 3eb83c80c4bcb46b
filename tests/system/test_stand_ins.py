"""Every reader recognises pointers, web pages and empty files in place of data, and says what to do."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from data_folders import noise, write_colmap, write_image, write_transforms
from layout_folders import write_llff
from parsed_views import parse

from beags_plugin.plugin.views.dataparser import BeagsDataParserConfig
from beags_plugin.plugin.views.dataset import BeagsDataset
from beags_plugin.system.errors import UserError
from beags_plugin.system.reading.arrays import load_array
from beags_plugin.system.reading.stand_ins import stand_in
from beags_plugin.system.reading.tensors import load_tensors
from beags_plugin.system.reading.text import load_json

LFS = b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a214614ab2935c943f9e0ff69d22eadbb8f32b1\nsize 12345\n"
PAGE = b"\xef\xbb\xbf\n<!-- saved -->\n<!DOCTYPE HTML><html><head><title>Sign in</title></head></html>"
STAND_INS = {
    "a pointer of Git LFS": (LFS, "a pointer of Git LFS.*run git lfs pull"),
    "a pointer of git-annex": (b"/annex/objects/SHA256E-s9--ab.ply\n", "a pointer of git-annex.*run git annex get"),
    "a web page": (PAGE, "a web page.*open the link in a browser"),
    "a plain web page": (b"<html><body>404</body></html>", "a web page.*open the link in a browser"),
    "a server's error": (
        b'<?xml version="1.0"?>\n<Error><Code>AccessDenied</Code></Error>',
        "error message of the ser",
    ),
    "an empty file": (b"", "it is empty.*get it again"),
}


def in_transforms(root: Path, content: bytes) -> None:
    write_transforms(root)
    (root / "transforms.json").write_bytes(content)


def in_a_photo(root: Path, content: bytes) -> None:
    write_transforms(root)
    (root / "images/v01.png").write_bytes(content)


def in_a_mask(root: Path, content: bytes) -> None:
    write_transforms(root)
    for index in range(9):
        write_image(root / f"masks/v{index:02d}.png", noise(0)[..., 0] // 200)
    (root / "masks/v01.png").write_bytes(content)


def in_seed_points(root: Path, content: bytes) -> None:
    write_transforms(root, ply_file_path="points.ply")
    (root / "points.ply").write_bytes(content)


def in_colmap(name: str):
    def make(root: Path, content: bytes) -> None:
        write_colmap(root, text=name.endswith("txt"), points=[[0.1, 0.2, 0.3]])
        (root / "sparse/0" / name).write_bytes(content)

    return make


def in_llff(root: Path, content: bytes) -> None:
    write_llff(root)
    (root / "poses_bounds.npy").write_bytes(content)


def in_class_names(root: Path, content: bytes) -> None:
    write_transforms(root)
    (root / "classes.json").write_bytes(content)


READERS = {
    "transforms.json": in_transforms,
    "a photo": in_a_photo,
    "a mask": in_a_mask,
    "seed points": in_seed_points,
    **{name: in_colmap(name) for name in ("cameras.bin", "images.bin", "points3D.bin", "cameras.txt", "images.txt")},
    "LLFF": in_llff,
    "classes.json": in_class_names,
}
NO_DATA = {("cameras.txt", "an empty file"), ("images.txt", "an empty file")}  # an empty one holds no camera or image


@pytest.mark.parametrize("kind", STAND_INS)
@pytest.mark.parametrize("reader", READERS)
def test_every_reader_names_the_cause_and_the_command(tmp_path, reader, kind):
    content, words = STAND_INS[kind]
    READERS[reader](tmp_path, content)
    words = ".*" if (reader, kind) in NO_DATA else words
    with pytest.raises(UserError, match=words) as raised:
        BeagsDataset(BeagsDataParserConfig(data=tmp_path).setup().get_dataparser_outputs("train"))[0]
    assert "\n" not in str(raised.value) and str(raised.value).endswith(".")


@pytest.mark.parametrize("kind", STAND_INS)
@pytest.mark.parametrize("load", [load_array, load_tensors, load_json])
def test_readers_of_files_say_it(tmp_path, load, kind):
    content, words = STAND_INS[kind]
    (tmp_path / "a").write_bytes(content)
    with pytest.raises(ValueError, match=words):
        load(tmp_path / "a")


def test_an_empty_list_of_points_is_no_broken_file(tmp_path):
    write_colmap(tmp_path / "text", text=True)  # COLMAP's manual asks for an empty points3D.txt
    write_colmap(tmp_path / "binary")
    for form in ("text", "binary"):
        assert parse(tmp_path / form, num_random_points=10).metadata["points3D_random"]


def test_data_is_no_stand_in(tmp_path):
    np.save(tmp_path / "a.npy", np.zeros(3))
    (tmp_path / "b.json").write_text('{"page": "<html>"}')
    for path in (*tmp_path.iterdir(), tmp_path, tmp_path / "absent"):
        assert stand_in(path) is None
    shutil.rmtree(tmp_path)
