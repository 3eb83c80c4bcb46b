"""Colours of points in every type that programs write."""

from __future__ import annotations

import numpy as np
import pytest

from beags_plugin.system.reading.colors import as_bytes
from beags_plugin.system.reading.ply import read_ply_points, write_vertices

BYTES = np.array([[0, 128, 255], [7, 200, 33]])
FORMS = {
    "bytes": BYTES.astype(np.uint8),
    "signed bytes": BYTES.astype(np.uint8).view(np.int8),
    "bytes in 16 bits": BYTES.astype(np.uint16),
    "bytes in 32 bits": BYTES.astype(np.int32),
    "16 bits": (BYTES * 257).astype(np.uint16),
    "16 bits, signed": (BYTES * 257).astype(np.uint16).view(np.int16),
    "16 bits in 32": (BYTES * 257).astype(np.int32),
    "shares": (BYTES / 255).astype(np.float32),
    "shares, double": BYTES / 255,
    "floats to 255": BYTES.astype(np.float32),
    "doubles to 255": BYTES.astype(np.float64),
    "floats of 16 bits": (BYTES * 257).astype(np.float32),
}


@pytest.mark.parametrize("names", [("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue")], ids=str)
@pytest.mark.parametrize("order", ["<", ">", ""], ids=["little", "big", "text"])
@pytest.mark.parametrize("form", FORMS)
def test_colours_of_any_type_are_the_same_bytes(tmp_path, form, order, names):
    values = FORMS[form]
    kinds = {"i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "f4": "float", "f8": "double"}
    kind = values.dtype.str[1:]
    word = {"<": "binary_little_endian", ">": "binary_big_endian", "": "ascii"}[order]
    head = f"ply\nformat {word} 1.0\nelement vertex 2\n" + "".join(f"property double {axis}\n" for axis in "xyz")
    head += "".join(f"property {kinds[kind]} {name}\n" for name in names) + "end_header\n"
    if order:
        table = np.zeros(2, [(axis, f"{order}f8") for axis in "xyz"] + [(name, f"{order}{kind}") for name in names])
        for column, name in enumerate(names):
            table[name] = values[:, column]
        body = table.tobytes()
    else:
        body = "".join(f"0 0 0 {' '.join(map(repr, row))}\n" for row in values.tolist()).encode()
    (tmp_path / "a.ply").write_bytes(head.encode() + body)
    positions, colors = read_ply_points(tmp_path / "a.ply")
    assert positions.dtype == np.float64 and colors.dtype == np.uint8
    np.testing.assert_array_equal(colors, BYTES)


def test_colours_that_fit_no_range_are_grey_and_so_is_no_number():
    assert (as_bytes(np.array([[-5e3, 0.0, 9e6]] * 4)) == 128).all()
    assert as_bytes(np.array([[0.5, np.nan, 0.5], [1.0, 0.0, 0.2]])).tolist() == [[128] * 3, [255, 0, 51]]
    assert as_bytes(np.zeros((0, 3))).shape == (0, 3)


def test_a_few_bright_points_do_not_change_the_range():
    shares = np.full((1000, 3), 0.5)
    shares[0] = 3.0
    assert as_bytes(shares)[1].tolist() == [128] * 3 and as_bytes(shares)[0].tolist() == [255] * 3


def test_splats_serve_as_seed_points_with_their_colours(tmp_path):
    names = [*"xyz", "f_dc_0", "f_dc_1", "f_dc_2"]
    table = np.zeros(1, [(name, "<f4") for name in names])
    for index, share in enumerate((1.0, 0.5, 0.25)):
        table[f"f_dc_{index}"] = (share - 0.5) / 0.28209479177387814
    with open(tmp_path / "a.ply", "wb") as file:
        write_vertices(file, table)
    assert read_ply_points(tmp_path / "a.ply")[1].tolist() == [[255, 128, 64]]
