"""Readers of files of any origin as functions of bytes, with small valid files to begin with: for ``fuzz_parsers``."""

from __future__ import annotations

from parser_targets import images, points, poses, tensors, texts
from parser_targets.target import Target, examine

__all__ = ["TARGETS", "Target", "examine"]

TARGETS = points.TARGETS | poses.TARGETS | texts.TARGETS | tensors.TARGETS | images.TARGETS
"""Parsers by name."""
