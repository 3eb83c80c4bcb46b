"""Random points of the UV disc by a hash of counters, independent of all other sampling (method, section 6)."""

from __future__ import annotations

import math

import torch
from torch import Tensor

RADIUS = 3.0  # the disc's radius, in units of the scales (method, section 6)

_WORD = (1 << 64) - 1
_GOLDEN = 0x9E3779B97F4A7C15  # 2^64 / golden ratio: counters times it are spread over all bits
_MULTIPLIERS = (0xBF58476D1CE4E5B9, 0x94D049BB133111EB)  # multipliers of SplitMix64, as are the shifts 30, 27, 31


def _mix(word: int) -> int:
    """Apply the SplitMix64 finaliser to one 64-bit word."""
    word = ((word ^ (word >> 30)) * _MULTIPLIERS[0]) & _WORD
    word = ((word ^ (word >> 27)) * _MULTIPLIERS[1]) & _WORD
    return word ^ (word >> 31)


def _signed(word: int) -> int:
    return word - (1 << 64) if word >> 63 else word


def _logical_shift(words: Tensor, bits: int) -> Tensor:
    return (words >> bits) & ((1 << (64 - bits)) - 1)  # >> alone would copy the sign bit


def _mix_tensor(words: Tensor) -> Tensor:
    """Apply ``_mix`` to every element of an int64 tensor (multiplication wraps)."""
    words = (words ^ _logical_shift(words, 30)) * _signed(_MULTIPLIERS[0])
    words = (words ^ _logical_shift(words, 27)) * _signed(_MULTIPLIERS[1])
    return words ^ _logical_shift(words, 31)


def sample_stream(seed: int, step: int) -> int:
    """Hash seed and step into the 64 bits shared by all counters of one step."""
    return _mix((_mix(seed & _WORD) + step * _GOLDEN) & _WORD)


def sample_words(seed: int, step: int, gaussians: Tensor, samples: Tensor) -> Tensor:
    """Hash seed, step, Gaussian and sample into 64 random bits for every (sample, Gaussian).

    gaussians: [N] int64 indices. samples: [Z] int64 sample numbers. Returns [Z, N] int64.
    """
    per_gaussian = _mix_tensor(gaussians * _signed(_GOLDEN) + _signed(sample_stream(seed, step)))
    return _mix_tensor(per_gaussian + (samples * _signed(_GOLDEN))[:, None])


def disc_points(words: Tensor, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Return (u, v), uniform in the disc of radius 3, from int64 words of any shape.

    float32 and float64 give the same points, up to rounding.
    """
    # Each coordinate has 24 bits, as in float32; the two halves of the word are independent.
    radial = _logical_shift(words, 40).to(dtype) * 2.0**-24
    angle = ((words >> 8) & 0xFFFFFF).to(dtype) * (2.0**-24 * 2.0 * math.pi)
    radius = RADIUS * radial.sqrt()  # area grows with the square of the radius
    return radius * angle.cos(), radius * angle.sin()
