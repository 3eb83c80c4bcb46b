"""Fixtures of the tests of baselines; their other helpers are those of tests/support."""

from __future__ import annotations

from every_backend import rasterizer  # noqa: F401
