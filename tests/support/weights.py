"""Weights of networks for tests: fetched where a network is, else the tests are skipped."""

from __future__ import annotations

from pathlib import Path

import pytest

from beags_plugin.masks.sources.salient import fetch_weights
from beags_plugin.system.errors import UserError


def fetch(folder: Path) -> None:
    """Have ``beags masks weights`` fetch u2netp into a folder."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("U2NET_HOME", str(folder))
        try:
            fetch_weights()
        except UserError as error:
            pytest.skip(str(error))


def onnx_model(given: list[int], found: list[int]) -> bytes:
    """Return an ONNX model that hands its input on, with these shapes declared, in protobuf's own encoding."""

    def field(number: int, value: int | bytes | str) -> bytes:
        if isinstance(value, int):
            return bytes([number << 3]) + varint(value)
        value = value.encode() if isinstance(value, str) else value
        return bytes([number << 3 | 2]) + varint(len(value)) + value

    def varint(value: int) -> bytes:
        return bytes([value]) if value < 128 else bytes([value & 127 | 128]) + varint(value >> 7)

    def port(name: str, shape: list[int]) -> bytes:
        sizes = b"".join(field(1, field(1, size)) for size in shape)
        return field(1, name) + field(2, field(1, field(1, 1) + field(2, sizes)))

    node = field(1, "x") + field(2, "y") + field(4, "Identity")
    graph = field(1, node) + field(2, "g") + field(11, port("x", given)) + field(12, port("y", found))
    return field(1, 8) + field(7, graph) + field(8, field(2, 13))
