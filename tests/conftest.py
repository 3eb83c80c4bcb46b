"""Fixtures that all tests share."""

from __future__ import annotations

import pytest

from beags_plugin.rasterizers import RASTERIZERS


@pytest.fixture(params=["torch", "native"])
def rasterizer(request):
    """Every backend in turn; one that cannot run here is skipped with its reason."""
    backend = RASTERIZERS.get(request.param)
    if reason := backend.unavailable():
        pytest.skip(f"{request.param}: {reason}")
    return backend()
