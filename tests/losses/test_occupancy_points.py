"""The random points of the occupancy loss: uniform, independent, and decided by their counters alone."""

from __future__ import annotations

import math

import pytest
import torch

from beags_plugin.occupancy.sampling import disc_points, sample_words


def test_points_are_uniform_in_the_disc():
    words = sample_words(0, 0, torch.arange(500), torch.arange(200))
    u, v = (value.flatten() for value in disc_points(words, torch.float64))
    radius = u * u + v * v
    assert float(radius.max()) < 9.0
    count = radius.numel()
    tolerance = 5 / math.sqrt(count)
    # area and angle are uniform, and independent of each other
    area = torch.histc(radius / 9, bins=10, min=0, max=1) / count
    angle = torch.histc(torch.atan2(v, u), bins=12, min=-math.pi, max=math.pi) / count
    assert torch.allclose(area, torch.full_like(area, 0.1), atol=0.3 * tolerance)
    assert torch.allclose(angle, torch.full_like(angle, 1 / 12), atol=0.3 * tolerance)
    for moment, expected in [(u, 0), (v, 0), (u * v, 0), (u * u, 9 / 4), (v * v, 9 / 4), (radius**2, 27)]:
        assert float(moment.mean()) == pytest.approx(expected, abs=12 * tolerance)


def test_neighbouring_counters_are_independent():
    words = {
        "seed": [sample_words(s, 0, torch.arange(1), torch.arange(1)) for s in range(2000)],
        "step": [sample_words(0, s, torch.arange(1), torch.arange(1)) for s in range(2000)],
        "gaussian": list(sample_words(0, 0, torch.arange(2000), torch.arange(1))[0]),
        "sample": list(sample_words(0, 0, torch.arange(1), torch.arange(2000))),
    }
    for name, values in words.items():
        flat = torch.stack([value.reshape(()) for value in values])
        assert len(flat.unique()) == 2000, name
        u, _ = disc_points(flat, torch.float64)
        correlation = (u[1:] * u[:-1]).mean() / (u * u).mean()
        assert abs(float(correlation)) < 0.1, name
        bits = torch.stack([(flat >> bit) & 1 for bit in range(64)]).double().mean(1)
        assert float((bits - 0.5).abs().max()) < 0.06, name
    assert len(torch.cat([torch.stack([v.reshape(()) for v in vs]) for vs in words.values()]).unique()) == 7997


def test_words_do_not_depend_on_what_else_is_asked():
    whole = sample_words(5, 9, torch.arange(100), torch.arange(20))
    part = sample_words(5, 9, torch.tensor([70, 3]), torch.tensor([19, 4]))
    assert torch.equal(part, whole[[19, 4]][:, [70, 3]])
    a, b = disc_points(whole, torch.float32), disc_points(whole, torch.float64)
    assert torch.allclose(a[0].double(), b[0], atol=1e-6) and torch.allclose(a[1].double(), b[1], atol=1e-6)


def test_words_are_the_splitmix_finaliser():
    """The tensor hash equals the integer hash, written again here with Python's unbounded integers."""
    mask = (1 << 64) - 1

    def mix(word: int) -> int:
        word = (word ^ (word >> 30)) * 0xBF58476D1CE4E5B9 & mask
        word = (word ^ (word >> 27)) * 0x94D049BB133111EB & mask
        return word ^ (word >> 31)

    golden = 0x9E3779B97F4A7C15
    words = sample_words(11, 13, torch.arange(4), torch.arange(3))
    for sample in range(3):
        for gaussian in range(4):
            stream = mix(mix(11) + 13 * golden & mask)
            expected = mix(mix(gaussian * golden + stream & mask) + sample * golden & mask)
            assert int(words[sample, gaussian]) & mask == expected
