"""Readers of compressed splat files, written from the formats' descriptions and apart from what writes them.

Each returns the Gaussians as arrays by name, float64: means, log_scales [N, 3], alphas [N], quats [N, 4] wxyz, sh_dc
[N, 3], sh_rest [N, K, 3]. They trust the file: for files that a measurement or a test has just written.
"""

from __future__ import annotations

import gzip
import io
import json
import math
import struct
import zipfile
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from beags_plugin.core.surfels import Surfels

Arrays = dict[str, np.ndarray]
C0 = 1 / math.sqrt(4 * math.pi)  # the constant basis function
COEFFICIENTS = {0: 0, 1: 3, 2: 8, 3: 15}  # of the higher bands, a colour
_TYPES = {"float": "<f4", "uint": "<u4", "uchar": "u1"}
# The sign of each basis function (in the files' order) when y and z are turned over: those of its y and z factors.
SH_SIGNS = np.array([-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1])


def surfels_of(arrays: Arrays) -> Surfels:
    """Return the surfels that the arrays' first two scales make, float32."""

    def tensor(values: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(values)).float()

    logits = torch.logit(tensor(arrays["alphas"]), eps=1e-6)
    flat = tensor(arrays["log_scales"][:, :2])
    return Surfels(
        tensor(arrays["means"]),
        tensor(arrays["quats"]),
        flat,
        logits,
        tensor(arrays["sh_dc"]),
        tensor(arrays["sh_rest"]),
    )


def _lifted(three: np.ndarray, largest: np.ndarray) -> np.ndarray:
    """Return quaternions from three components and the place of the fourth, which follows from the length 1."""
    fourth = np.sqrt(np.maximum(0.0, 1.0 - (three**2).sum(axis=1)))
    quats = [np.insert(row, place, value) for row, place, value in zip(three, largest, fourth, strict=True)]
    return np.array(quats).reshape(-1, 4)


def read_compressed_ply(path: Path) -> Arrays:
    """Read PlayCanvas' compressed .ply."""
    data = path.read_bytes()
    end = data.index(b"end_header\n") + len(b"end_header\n")
    lines = data[:end].decode().splitlines()
    if lines[:2] != ["ply", "format binary_little_endian 1.0"]:
        raise ValueError(f"{path} is no binary little-endian .ply")
    tables, counts = {}, {}
    for line in lines:
        word, *rest = line.split()
        if word == "element":
            tables[rest[0]], counts[rest[0]] = [], int(rest[1])
        elif word == "property":
            list(tables.values())[-1].append((rest[1], _TYPES[rest[0]]))
    found = {}
    for name, fields in tables.items():
        found[name] = np.frombuffer(data, np.dtype(fields), counts[name], end)
        end += found[name].nbytes
    if end != len(data):
        raise ValueError(f"{path} is {len(data)} bytes long instead of {end}")
    chunk, vertex = found["chunk"][np.arange(counts["vertex"]) // 256], found["vertex"]

    def unpacked(word: str, bits: tuple[int, ...]) -> np.ndarray:
        values, shift, parts = vertex[word].astype(np.int64), sum(bits), []
        for width in bits:
            shift -= width
            parts.append((values >> shift & 2**width - 1) / (2**width - 1))
        return np.stack(parts, axis=1)

    def between(places: np.ndarray, names: list[str]) -> np.ndarray:
        low, high = (
            np.stack([chunk[f"{end}_{name}"].astype(float) for name in names], axis=1) for end in ("min", "max")
        )
        return low + places * (high - low)

    color = unpacked("packed_color", (8, 8, 8, 8))
    three = (unpacked("packed_rotation", (10, 10, 10)) - 0.5) * math.sqrt(2)
    count = counts["vertex"]
    rest = np.zeros((count, 0))
    if "sh" in found:
        rest = np.stack([found["sh"][name] for name, _ in tables["sh"]], axis=1).astype(float)
        rest = 8 * ((rest + 0.5) / 256 - 0.5)
    return {
        "means": between(unpacked("packed_position", (11, 10, 11)), ["x", "y", "z"]),
        "log_scales": between(unpacked("packed_scale", (11, 10, 11)), ["scale_x", "scale_y", "scale_z"]),
        "alphas": color[:, 3],
        "quats": _lifted(three, vertex["packed_rotation"] >> 30),
        "sh_dc": (between(color[:, :3], ["r", "g", "b"]) - 0.5) / C0,
        "sh_rest": rest.reshape(count, 3, -1).transpose(0, 2, 1),
    }


def read_sog(path: Path) -> Arrays:
    """Read PlayCanvas' .sog, version 2."""
    with zipfile.ZipFile(path) as archive:
        if archive.testzip() is not None:
            raise ValueError(f"{path} is damaged")
        meta = json.loads(archive.read("meta.json"))
        count = meta["count"]

        def image(name: str) -> np.ndarray:
            opened = Image.open(io.BytesIO(archive.read(name)))
            return np.asarray(opened.convert("RGBA")).astype(np.int64)

        def pixels(name: str) -> np.ndarray:
            return image(name).reshape(-1, 4)[:count]

        low, high = np.array(meta["means"]["mins"]), np.array(meta["means"]["maxs"])
        lower, upper = (pixels(name)[:, :3] for name in meta["means"]["files"])
        logs = low + (256 * upper + lower) / 65535 * (high - low)
        quats = pixels(meta["quats"]["files"][0])
        scales, sh0 = pixels(meta["scales"]["files"][0]), pixels(meta["sh0"]["files"][0])
        rest = np.zeros((count, 0, 3))
        if "shN" in meta:
            bands = COEFFICIENTS[meta["shN"]["bands"]]
            centroids, labels = image(meta["shN"]["files"][0]), pixels(meta["shN"]["files"][1])
            entries = labels[:, 0] + 256 * labels[:, 1]
            if entries.max() >= meta["shN"]["count"]:
                raise ValueError(f"{path} names an entry that its palette lacks")
            columns = (entries % 64)[:, None] * bands + np.arange(bands)
            rest = np.array(meta["shN"]["codebook"])[centroids[(entries // 64)[:, None], columns, :3]]
    return {
        "means": np.sign(logs) * np.expm1(np.abs(logs)),
        "log_scales": np.array(meta["scales"]["codebook"])[scales[:, :3]],
        "alphas": sh0[:, 3] / 255,
        "quats": _lifted((quats[:, :3] / 255 - 0.5) * math.sqrt(2), quats[:, 3] - 252),
        "sh_dc": np.array(meta["sh0"]["codebook"])[sh0[:, :3]],
        "sh_rest": rest,
    }


def read_spz(path: Path) -> Arrays:
    """Read a .spz of version 2, in its own axes (right, up, backward), one number at a time."""
    data = gzip.decompress(path.read_bytes())
    magic, version, count, degree, bits, flags, reserved = struct.unpack_from("<IIIBBBB", data)
    if (magic, version, flags, reserved) != (0x5053474E, 2, 0, 0):
        raise ValueError(f"{path} is no .spz of version 2")
    at = 16

    def take(number: int) -> bytes:
        nonlocal at
        at += number
        if at > len(data):
            raise ValueError(f"{path} ends too early")
        return data[at - number : at]

    positions = [int.from_bytes(take(3), "little", signed=True) / 2**bits for _ in range(3 * count)]
    alphas = [byte / 255 for byte in take(count)]
    colors = [(byte / 255 - 0.5) / 0.15 for byte in take(3 * count)]
    scales = [byte / 16 - 10 for byte in take(3 * count)]
    quats = []
    for _ in range(count):
        x, y, z = (byte / 127.5 - 1 for byte in take(3))
        quats.append((math.sqrt(max(0.0, 1 - x * x - y * y - z * z)), x, y, z))
    sh = [(byte - 128) / 128 for byte in take(3 * COEFFICIENTS[degree] * count)]
    if at != len(data):
        raise ValueError(f"{path} is too long")
    return {
        "means": np.array(positions).reshape(count, 3),
        "alphas": np.array(alphas),
        "sh_dc": np.array(colors).reshape(count, 3),
        "log_scales": np.array(scales).reshape(count, 3),
        "quats": np.array(quats).reshape(count, 4),
        "sh_rest": np.array(sh).reshape(count, COEFFICIENTS[degree], 3),  # colour is the inner axis
    }


def in_ply_axes(arrays: Arrays) -> Arrays:
    """Turn what ``read_spz`` read to the axes of .ply files: y and z change their signs."""
    rest = arrays["sh_rest"]
    return arrays | {
        "means": arrays["means"] * [1, -1, -1],
        "quats": arrays["quats"] * [1, 1, -1, -1],
        "sh_rest": rest * SH_SIGNS[: rest.shape[1], None],
    }
