"""Fixtures that all tests share."""

from __future__ import annotations

import pytest
import torch

from beags_plugin.ops import extension
from beags_plugin.rasterizers import RASTERIZERS


@pytest.fixture(params=["torch", "native"])
def rasterizer(request):
    """Every backend in turn; one that cannot run here is skipped with its reason."""
    backend = RASTERIZERS.get(request.param)
    if reason := backend.unavailable():
        pytest.skip(f"{request.param}: {reason}")
    return backend()


@pytest.fixture(params=["torch", "compiled"])
def ops(request, monkeypatch):
    """The torch versions of the ops, then the compiled ones; skipped where those were not built."""
    if request.param == "torch":
        monkeypatch.setattr(extension, "load", lambda: None)
    elif extension.load() is None:
        pytest.skip("beags_plugin._native was not built")
    return request.param


@pytest.fixture
def without_extension(monkeypatch):
    """A function that computes something as if the extension were absent."""

    def compute(call):
        with monkeypatch.context() as patch:
            patch.setattr(extension, "load", lambda: None)
            return call()

    return compute


@pytest.fixture
def for_threads():
    """A function that computes something on 1, 2 and 4 threads, and returns the three results."""
    before = torch.get_num_threads()

    def compute(call):
        results = []
        for count in (1, 2, 4):
            torch.set_num_threads(count)
            results.append(call())
        return results

    yield compute
    torch.set_num_threads(before)
