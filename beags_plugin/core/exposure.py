"""Exposures of photos relative to their mean, from the places that several photos show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from beags_plugin.core.color_fit import apply_affine

DARK, BRIGHT = 0.02, 0.95  # Linear light; outside this range noise and clipping hide the exposure.
_RIDGE = 1e-3  # share of the photos' mean evidence; it determines photos that share no place with others
_ROUNDS = 12  # rounds of reweighting, which turn least squares into least absolute differences
_LEAST_RESIDUAL = 0.02  # log2 units; a smaller residual counts no more than this one
_NORMAL = 1.4826  # standard deviation of a normal distribution over its median absolute deviation
_MEDIAN_COST = 1.25  # standard error of a median over that of a mean
_LEAST_GAIN = 0.02  # least singular value to invert; a photo below it is black, and its inverse would show noise


@dataclass(frozen=True)
class Exposures:
    """The affine colour transforms from a scene, which has the mean photo's exposure, to each of its photos.

    names: those of V photos. affine: [V, 3, 4] float, on colours in the photos' values, see ``color_fit.apply_affine``.
    """

    names: tuple[str, ...]
    affine: Tensor

    def evened(self, photo: Tensor, name: str) -> Tensor:
        """Return a photo [H, W, 3] in 0..1 with the mean photo's exposure.

        A photo whose transform is unknown, or cannot be inverted (a black photo's), is returned unchanged.
        """
        if name not in self.names:
            return photo
        affine = self.affine[self.names.index(name)].double()
        if float(torch.linalg.svdvals(affine[:, :3])[-1]) < _LEAST_GAIN:
            return photo
        matrix = torch.linalg.inv(affine[:, :3])
        inverse = torch.cat([matrix, -(matrix @ affine[:, 3:])], dim=1)
        return apply_affine(photo, inverse).clamp(0.0, 1.0)


def not_beyond_white(color: Tensor, photo: Tensor) -> Tensor:
    """Return a rendering [H, W, 3] that has no gradient where the photo is saturated and the rendering brighter.

    A photo cuts light off at 1, so it does not contradict a scene that is brighter there.
    """
    return torch.where((photo >= 1.0) & (color > photo), photo, color)


@dataclass(frozen=True)
class Sightings:
    """M observations of places by photos: place [M] int64, photo [M] int64, light [M, 3] float64, linear."""

    place: np.ndarray
    photo: np.ndarray
    light: np.ndarray


@dataclass(frozen=True)
class Gains:
    """How many stops each of V photos is brighter than their mean: stops [V, 3], by colour, each with a mean of 0.

    noise: [V], the standard error of the stops; infinite for a photo without any evidence.
    """

    stops: np.ndarray
    noise: np.ndarray

    @property
    def spread(self) -> float:
        """Return the standard deviation of the photos' gains, in EV: the mean over the colours of each photo."""
        return float(self.stops.mean(axis=1).std())

    @property
    def spread_of_colors(self) -> float:
        """Return the standard deviation of the gains by colour about their photo's gain, in EV."""
        return float((self.stops - self.stops.mean(axis=1, keepdims=True)).std())


def gains(sightings: Sightings, count: int) -> Gains:
    """Return the gains of ``count`` photos that explain best how bright each shows the same places.

    log2 light of place p in photo v = log2 colour of p + gain of v, with the least absolute error by reweighted least
    squares, because reflections and wrong matches are outliers. A place counts if two photos or more show it neither
    dark nor bright.
    """
    usable = ((sightings.light > DARK) & (sightings.light < BRIGHT)).all(axis=1)
    _, inverse = np.unique(sightings.place, return_inverse=True)
    usable &= np.bincount(inverse[usable], minlength=len(inverse))[inverse] > 1
    place, photo = np.unique(sightings.place[usable], return_inverse=True)[1], sightings.photo[usable]
    logs = np.log2(sightings.light[usable])
    stops, residuals = np.zeros((count, 3)), np.zeros_like(logs)
    for channel in range(3):
        weights = np.ones(len(logs))
        for _ in range(_ROUNDS if len(logs) else 0):
            exposures, colors = even_exposures(place, photo, logs[:, channel], weights, count)
            residuals[:, channel] = logs[:, channel] - colors[place] - exposures[photo]
            weights = 1.0 / np.maximum(np.abs(residuals[:, channel]), _LEAST_RESIDUAL)
            stops[:, channel] = exposures - exposures.mean()
    seen = np.bincount(photo, minlength=count)
    spread = _NORMAL * float(np.median(np.abs(residuals))) if len(logs) else 0.0
    noise = np.where(seen > 0, _MEDIAN_COST * spread / np.sqrt(np.maximum(seen, 1)), np.inf)
    return Gains(np.round(stops, 5), noise)  # Rounding removes the solver's last bits, which differ by machine.


def even_exposures(
    place: np.ndarray, photo: np.ndarray, logs: np.ndarray, weights: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the log exposure of each photo, [count], with a mean of about 0, and the log colour of each place, [P].

    Weighted least squares: log light of place p in photo v = log colour of p + log exposure of v. Eliminating the
    colours leaves a Laplacian over the photos.

    place, photo: [M] int64, no pair twice. logs, weights: [M] float64.
    """
    from scipy.sparse import csr_matrix  # pyright: ignore[reportAttributeAccessIssue]  (compiled, without stubs)

    places = int(place.max(initial=-1)) + 1
    of_place = np.maximum(np.bincount(place, weights, places), 1e-300)
    colors = np.bincount(place, weights * logs, places) / of_place
    shares = csr_matrix((weights / of_place[place], (place, photo)), (places, count))
    evidence = np.bincount(photo, weights, count)
    right = np.bincount(photo, weights * (logs - colors[place]), count)
    laplacian = np.diag(evidence) - (csr_matrix((weights, (place, photo)), (places, count)).T @ shares).toarray()
    ridge = _RIDGE * evidence.mean() + 1e-12
    exposures = np.linalg.solve(laplacian + ridge * np.eye(count), right)
    return exposures, colors - np.bincount(place, weights * exposures[photo], places) / of_place


def sightings(ids: Sequence[np.ndarray], light: Sequence[np.ndarray]) -> Sightings:
    """Gather the observations of all photos: per photo, ids of places [M] int64 (below 0: no place), light [M, 3].

    Of several observations of a place by a photo the first counts.
    """
    places, photos, lights = [], [], []
    for photo, (own, seen) in enumerate(zip(ids, light, strict=True)):
        place, first = np.unique(own, return_index=True)
        first = first[place >= 0]
        places.append(own[first])
        photos.append(np.full(len(first), photo))
        lights.append(seen[first])
    if not places:
        return Sightings(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3)))
    return Sightings(np.concatenate(places), np.concatenate(photos), np.concatenate(lights))
