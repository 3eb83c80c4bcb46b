"""Vertices of .ply files, written here byte by byte."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from beags_plugin.system.errors import UserError
from beags_plugin.system.reading.ply import read_ply_points, read_vertices, write_vertices

HEADER = (
    "ply{end}format {form} 1.0{end}comment made by hand{end}element camera 2{end}property double f{end}"
    "element vertex 2{end}property float x{end}property uchar red{end}property short y{end}end_header{end}"
)
ROWS = [(0.5, 7, -3), (-2.25, 255, 4)]


@pytest.mark.parametrize("end", ["\n", "\r\n"], ids=["lf", "crlf"])
@pytest.mark.parametrize("order", ["<", ">", ""], ids=["little", "big", "text"])
def test_numbers_of_every_form_are_read(tmp_path, order, end):
    form = {"<": "binary_little_endian", ">": "binary_big_endian", "": "ascii"}[order]
    header = HEADER.format(form=form, end=end).encode("ascii")
    if order:
        body = struct.pack(f"{order}2d", 1, 2) + b"".join(struct.pack(f"{order}fBh", *row) for row in ROWS) + b"more"
    else:
        body = end.join(["1", "2", *(" ".join(map(str, row)) for row in ROWS), "more"]).encode("ascii")
    (tmp_path / "a.ply").write_bytes(header + body)
    assert read_vertices(tmp_path / "a.ply").tolist() == ROWS


@pytest.mark.parametrize("order", ["<", ""], ids=["binary", "text"])
def test_lists_are_skipped(tmp_path, order):
    header = (
        f"ply\nformat {'binary_little_endian' if order else 'ascii'} 1.0\nelement vertex 2\nproperty int a\n"
        "property list uchar short more\nproperty int b\nend_header\n"
    )
    body = struct.pack("<iB2hiiBi", 1, 2, 8, 9, 3, 4, 0, 5) if order else b"1 2 8 9 3\n4 0 5\n"
    (tmp_path / "a.ply").write_bytes(header.encode("ascii") + body)
    assert read_vertices(tmp_path / "a.ply").tolist() == [(1, 3), (4, 5)]


def test_what_is_written_is_read_again(tmp_path):
    table = np.array([(1.5, 2, 3), (4.5, 5, 6)], [("x", "<f4"), ("class_id", "<i4"), ("red", "u1")])
    with open(tmp_path / "a.ply", "wb") as file:
        write_vertices(file, table)
    lines = (tmp_path / "a.ply").read_bytes().split(b"\n")
    assert lines[2:7] == [
        b"element vertex 2",
        b"property float x",
        b"property int class_id",
        b"property uchar red",
        b"end_header",
    ]
    read = read_vertices(tmp_path / "a.ply")
    assert read.dtype == table.dtype and read.tolist() == table.tolist()


def test_points_have_the_colours_of_the_file_or_grey(tmp_path):
    header = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
    colors = "property float red\nproperty float green\nproperty float blue\n"
    (tmp_path / "grey.ply").write_text(f"{header}end_header\n1 2 3\n")
    (tmp_path / "red.ply").write_text(f"{header}{colors}end_header\n1 2 3 1 0.5 0\n")
    assert [part.tolist() for part in read_ply_points(tmp_path / "grey.ply")] == [[[1, 2, 3]], [[128, 128, 128]]]
    assert read_ply_points(tmp_path / "red.ply")[1].tolist() == [[255, 128, 0]]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("element vertex 1\nproperty half x\nend_header\n1\n", "unknown type 'half'"),
        ("element vertex 1\nproperty float x\nend_header\n1 2\n", "vertex 0 has 2 words instead of 1"),
        ("element vertex 1\nproperty float x\nend_header\nred\n", "column x: could not convert"),
        ("element vertex 1\nproperty list char int x\nend_header\n-1 2\n", "a list of -1 elements"),
        ("element vertex 2\nproperty float x\nend_header\n1234\n", "it has 1 of 2 vertices"),
        ("property float x\nend_header\n1\n", "its header has the line"),
        ("element face 1\nproperty float x\nend_header\n1\n", "'vertex' is missing"),
    ],
)
def test_what_is_no_ply_is_said(tmp_path, text, words):
    (tmp_path / "a.ply").write_text(f"ply\nformat ascii 1.0\n{text}")
    with pytest.raises(ValueError, match=words):
        read_vertices(tmp_path / "a.ply")


def test_a_file_that_is_cut_off_is_refused(tmp_path):
    header = "ply\nformat binary_big_endian 1.0\nelement vertex 1000000000000\nproperty float x\nend_header\n"
    (tmp_path / "a.ply").write_text(header + "1234")
    with pytest.raises(UserError, match="its header promises 4000000000000 bytes, but 4 follow"):
        read_vertices(tmp_path / "a.ply")
