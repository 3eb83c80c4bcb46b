"""The fixture of tests that all backends must pass."""

from __future__ import annotations

import pytest
from cuda_backends import BACKENDS

from beags_plugin.rasterizers import RASTERIZERS


@pytest.fixture(params=["torch", "native", *BACKENDS])
def rasterizer(request):
    """Every backend in turn; one that cannot run here is skipped with its reason."""
    backend = BACKENDS.get(request.param) or RASTERIZERS.get(request.param)
    if reason := backend.unavailable():
        pytest.skip(f"{request.param}: {reason}")
    return backend()
