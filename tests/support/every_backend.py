"""The fixtures of tests that all backends must pass."""

from __future__ import annotations

import pytest
from cuda_backends import BACKENDS

from beags_plugin.rasterizers import RASTERIZERS


def made(name: str):
    """Return the backend called ``name``; one that cannot run here skips the test with its reason."""
    backend = BACKENDS.get(name) or RASTERIZERS.get(name)
    if reason := backend.unavailable():
        pytest.skip(f"{name}: {reason}")
    return backend()


@pytest.fixture(params=["torch", "native", *BACKENDS])
def rasterizer(request):
    """Every backend in turn."""
    return made(request.param)


@pytest.fixture(params=["native", *BACKENDS])
def compiled(request):
    """Every backend but the torch reference, to be compared with it."""
    return made(request.param)
