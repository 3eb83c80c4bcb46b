"""Exposures of photos from the places that several of them show."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from beags_plugin.core.color_fit import apply_affine
from beags_plugin.core.exposure import BRIGHT, DARK, Exposures, Gains, Sightings, even_exposures, gains, sightings


def seen(
    stops: np.ndarray,
    places: int = 400,
    seed: int = 0,
    noise: float = 0.0,
    outliers: float = 0.0,
    group: int | None = None,
) -> Sightings:
    """Return what photos of these gains [V, 3] show: each place in about half of them.

    noise: standard deviation, log2 units. outliers: share of the sightings that show something else. group: photos
    before this one and the others share no place.
    """
    generator = np.random.default_rng(seed)
    colors = generator.uniform(-3.0, -1.5, (places, 3))
    shown = generator.uniform(size=(places, len(stops))) < 0.5
    if group is not None:
        shown[::2, :group] = shown[1::2, group:] = False
    place, photo = np.nonzero(shown)
    logs = colors[place] + stops[photo] + noise * generator.normal(size=(len(place), 3))
    wrong = generator.uniform(size=len(place)) < outliers
    logs[wrong] = generator.uniform(-5.0, -0.2, (int(wrong.sum()), 3))
    return Sightings(place, photo, np.exp2(logs))


def some_stops(count: int = 12, seed: int = 1) -> np.ndarray:
    """Return [V, 3] gains of exposure and white balance, each colour with a mean of 0."""
    generator = np.random.default_rng(seed)
    stops = generator.uniform(-0.7, 0.7, (count, 1)) + generator.uniform(-0.2, 0.2, (count, 3))
    return stops - stops.mean(axis=0)


def test_gains_are_found_by_colour():
    stops = some_stops()
    found = gains(seen(stops), len(stops))
    # The ridge, of a thousandth, draws them towards the mean a little.
    assert np.abs(found.stops - stops).max() < 3e-3
    assert np.abs(found.stops.mean(axis=0)).max() < 1e-4
    assert found.spread == pytest.approx(stops.mean(axis=1).std(), abs=2e-3)
    balance = stops - stops.mean(axis=1, keepdims=True)
    assert found.spread_of_colors == pytest.approx(balance.std(), abs=2e-3)


def test_noise_is_told_and_outliers_hardly_count():
    stops = some_stops()
    noisy = gains(seen(stops, noise=0.08), len(stops))
    assert np.abs(noisy.stops - stops).max() < 0.03
    assert 0.5 < np.median(noisy.noise) / (1.25 * 0.08 / np.sqrt(200)) < 1.5
    assert np.abs(noisy.stops - stops).std() < 2.0 * np.median(noisy.noise)
    wrong = gains(seen(stops, noise=0.08, outliers=0.15), len(stops))
    assert np.abs(wrong.stops - stops).max() < 0.05
    # Plain least squares, the first round, is drawn further.
    shown = seen(stops, noise=0.08, outliers=0.15)
    for channel in range(3):
        plain, _ = even_exposures(
            shown.place, shown.photo, np.log2(shown.light[:, channel]), np.ones(len(shown.place)), len(stops)
        )
        off = np.abs(plain - plain.mean() - stops[:, channel]).mean()
        assert np.abs(wrong.stops[:, channel] - stops[:, channel]).mean() < 0.5 * off


def test_photos_that_are_alike_have_no_gains():
    found = gains(seen(np.zeros((8, 3)), noise=0.08), 8)
    assert max(found.spread, found.spread_of_colors) < 3.0 * np.median(found.noise)
    assert gains(seen(np.zeros((8, 3))), 8).spread == 0.0


def test_black_and_burnt_out_sightings_say_nothing():
    """One photo shows nothing but these; the other gains are as without it."""
    stops = some_stops(8)
    shown = seen(stops)
    light = shown.light.copy()
    light[shown.photo == 3] = DARK / 2
    light[(shown.photo == 5) & (shown.place % 2 == 0)] = (0.5, 0.5, (1.0 + BRIGHT) / 2)
    found = gains(Sightings(shown.place, shown.photo, light), 8)
    rest = [0, 1, 2, 4, 5, 6, 7]
    assert np.isinf(found.noise[3]) and np.isfinite(found.noise[rest]).all()
    assert np.abs(found.stops[3] - found.stops[3].mean()).max() < 0.02  # The photo has no tint.
    differences = found.stops[rest] - found.stops[rest].mean(axis=0) - (stops[rest] - stops[rest].mean(axis=0))
    assert np.abs(differences).max() < 3e-3


def test_a_place_that_one_photo_alone_shows_is_no_evidence():
    told = seen(stops := some_stops(), noise=0.1)
    lone = np.arange(1000) + told.place.max() + 1
    light = np.full((1000, 3), 0.1)
    more = Sightings(
        np.append(told.place, lone), np.append(told.photo, np.zeros(1000, int)), np.append(told.light, light, axis=0)
    )
    found, plain = gains(more, len(stops)), gains(told, len(stops))
    assert np.array_equal(found.stops, plain.stops) and np.array_equal(found.noise, plain.noise)


def test_groups_of_photos_without_a_common_place_have_the_same_mean():
    stops = some_stops(10)
    found = gains(seen(stops, group=4), 10)
    for group in (slice(0, 4), slice(4, 10)):
        assert np.abs(found.stops[group] - (stops[group] - stops[group].mean(axis=0))).max() < 5e-3


@pytest.mark.parametrize("count", [0, 1, 5])
def test_photos_without_any_sighting(count):
    found = gains(sightings([np.zeros(0, np.int64)] * count, [np.zeros((0, 3))] * count), count)
    assert found.stops.shape == (count, 3) and not found.stops.any() and np.isinf(found.noise).all()


def test_order_of_photos_places_and_sightings_is_no_matter():
    stops = some_stops(6)
    shown = seen(stops, places=60, noise=0.1, outliers=0.1)
    found = gains(shown, 6)
    generator = np.random.default_rng(5)
    photos, places = generator.permutation(6), generator.permutation(60) * 1000  # Ids have gaps.
    order = generator.permutation(len(shown.place))
    moved = Sightings(places[shown.place][order], photos[shown.photo][order], shown.light[order])
    other = gains(moved, 6)
    assert np.abs(other.stops[photos] - found.stops).max() < 2e-5
    assert np.allclose(other.noise[photos], found.noise)


def test_gains_take_no_notice_of_the_units_of_light():
    shown = seen(some_stops(6), places=60)
    darker = Sightings(shown.place, shown.photo, 0.5 * shown.light)
    kept = ((darker.light > DARK) & (darker.light < BRIGHT)).all(axis=1)
    assert kept.all()
    assert np.abs(gains(darker, 6).stops - gains(shown, 6).stops).max() < 2e-5


def test_of_several_observations_of_a_place_the_first_counts():
    found = sightings(
        [np.array([7, -1, 7, 2]), np.array([-1])], [np.arange(12.0).reshape(4, 3), np.array([[9.0, 9.0, 9.0]])]
    )
    assert found.place.tolist() == [2, 7] and found.photo.tolist() == [0, 0]
    assert found.light.tolist() == [[9.0, 10.0, 11.0], [0.0, 1.0, 2.0]]


def test_sparse_sums_give_what_dense_ones_do():
    """The same system over a full table of places and photos, with the colours eliminated."""
    generator = np.random.default_rng(3)
    P, V = 40, 7
    weights = generator.uniform(0.1, 2.0, (P, V)) * (generator.uniform(size=(P, V)) < 0.4)
    weights[:, 2] = 0.0  # a photo without a place
    logs = generator.normal(size=(P, V))
    of_place = np.maximum(weights.sum(axis=1), 1e-300)
    shares = weights / of_place[:, None]
    colors = np.einsum("pv,pv->p", shares, logs)
    right = np.einsum("pv,pv->v", weights, logs - colors[:, None])
    evidence = weights.sum(axis=0)
    laplacian = np.diag(evidence) - np.einsum("pv,pw->vw", weights, shares)
    dense = np.linalg.solve(laplacian + (1e-3 * evidence.mean() + 1e-12) * np.eye(V), right)

    place, photo = np.nonzero(weights)
    found, of_places = even_exposures(place, photo, logs[place, photo], weights[place, photo], V)
    assert np.allclose(found, dense, atol=1e-10) and found[2] == 0.0
    last = int(place.max()) + 1
    best = np.einsum("pv,pv->p", shares, logs - found)[:last]
    assert np.allclose(of_places, best, atol=1e-10)


def test_a_photo_is_evened_out_by_the_inverse_of_its_transform():
    generator = torch.Generator().manual_seed(0)
    scene = 0.3 + 0.4 * torch.rand(5, 4, 3, generator=generator)
    affine = torch.eye(3, 4).repeat(2, 1, 1) + 0.1 * torch.randn(2, 3, 4, generator=generator)
    exposures = Exposures(("a", "b"), affine)
    for index, name in enumerate(exposures.names):
        photo = apply_affine(scene, affine[index])
        evened = exposures.evened(photo, name)
        assert evened.dtype == photo.dtype and torch.allclose(evened, scene, atol=1e-5)
        assert (photo - scene).abs().max() > 0.02
    assert torch.equal(exposures.evened(scene, "c"), scene)
    # What a photo has burnt out is no brighter than white.
    assert float(Exposures(("a",), 0.5 * torch.eye(3, 4)[None]).evened(torch.ones(1, 1, 3), "a").max()) == 1.0


@pytest.mark.parametrize("gain", [0.0, 0.01])
def test_a_black_photo_stays_as_it_is(gain):
    photo = torch.full((2, 2, 3), 0.01)
    assert torch.equal(Exposures(("a",), gain * torch.eye(3, 4)[None]).evened(photo, "a"), photo)


def test_spreads_are_of_exposure_and_of_colour_beside_it():
    gains_of = Gains(np.array([[1.0, 1.0, 1.0], [-1.0, -1.0, -1.0]]), np.zeros(2))
    assert gains_of.spread == 1.0 and gains_of.spread_of_colors == 0.0
    balances = Gains(np.array([[0.3, 0.0, -0.3], [-0.3, 0.0, 0.3]]), np.zeros(2))
    assert balances.spread == pytest.approx(0.0) and balances.spread_of_colors == pytest.approx(0.3 * np.sqrt(2 / 3))
