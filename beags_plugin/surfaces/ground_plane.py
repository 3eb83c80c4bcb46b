"""Find the plane that an object stands on, from points of the scene around its foot."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

# Lengths are relative to the object's size.
_REACH = 0.5  # horizontal distance from the object within which points count
_BAND = (0.5, 0.25, 0.1)  # vertical distance from its foot within which points count, by round, as up becomes known
_FLAT = 0.01  # distance from the plane within which a point lies on it
_STEEPEST = 1.5  # largest slope of the plane against the former up direction: 56 degrees
_FEWEST, _SHARE = 50, 0.2  # least number of points on the plane, and least share of the points around the foot
_SUNK = 0.05  # largest depth below the plane of the object's lowest tenth
_APART = 0.1  # largest distance of the object's foot from the plane


@dataclass(frozen=True)
class Plane:
    """Points x with normal . x = offset; normal: [3] float64, unit, towards the object."""

    normal: Tensor
    offset: float


def standing_plane(around: Tensor, own: Tensor, up: Tensor) -> Plane | None:
    """Return the plane that an object stands on; None if there is no plane around its foot, or it is not under it.

    around: [P, 3] float64, points of the scene without the object. own: [Q, 3] points of the object. up: [3], a guess
    that may be 50 degrees off.
    """
    if len(own) < 3:
        return None
    plane: Plane | None = None
    for band in _BAND:
        plane = _plane_near(around, own, up if plane is None else plane.normal, band)
        if plane is None:
            return None
    assert plane is not None
    height = own @ plane.normal - plane.offset
    size = _size(own)
    if float(height.quantile(0.1)) < -_SUNK * size or abs(float(height.quantile(0.01))) > _APART * size:
        return None
    return plane


def _plane_near(around: Tensor, own: Tensor, up: Tensor, band: float) -> Plane | None:
    from sklearn.linear_model import LinearRegression, RANSACRegressor

    turn = turn_to_z(up)
    points, item, size = around @ turn.T, own @ turn.T, _size(own)
    foot, middle = float(item[:, 2].quantile(0.02)), item[:, :2].median(dim=0).values
    reach = float((item[:, :2] - middle).norm(dim=1).quantile(0.98)) + _REACH * size
    near = ((points[:, :2] - middle).norm(dim=1) < reach) & ((points[:, 2] - foot).abs() < band * size)
    ring = ((points[near] - torch.cat([middle, middle.new_tensor([foot])])) / size).numpy()
    if len(ring) < _FEWEST:
        return None
    fit: Any = RANSACRegressor(
        LinearRegression(), min_samples=3, residual_threshold=_FLAT, max_trials=200, random_state=0,
        is_model_valid=lambda model, *_: bool(np.linalg.norm(model.coef_) < _STEEPEST),
    )  # fmt: skip
    try:
        fit.fit(ring[:, :2], ring[:, 2])
    except ValueError:  # Every sample was too steep.
        return None
    if fit.inlier_mask_.sum() < max(_FEWEST, _SHARE * len(ring)):
        return None
    slope, rise = fit.estimator_.coef_, float(fit.estimator_.intercept_)
    normal = torch.tensor([-slope[0], -slope[1], 1.0], dtype=torch.float64)
    normal = turn.T @ (normal / normal.norm())
    point = turn.T @ torch.cat([middle, middle.new_tensor([foot + rise * size])])
    return Plane(normal, float(normal @ point))


def _size(points: Tensor) -> float:
    """Return the longest side of the box of all but a few of the points."""
    ends = torch.stack([points.quantile(share, dim=0) for share in (0.01, 0.99)])
    return max(float((ends[1] - ends[0]).max()), 1e-12)


def turn_to_z(up: Tensor) -> Tensor:
    """Return the smallest rotation [3, 3] float64 that takes a direction [3] to z."""
    x, y, z = (up.double() / up.double().norm()).tolist()
    if z < -1 + 1e-12:
        return torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
    # Rodrigues' formula turns about up x z = (y, -x, 0), whose length is the sine, by the angle whose cosine is z.
    cross = torch.tensor([[0, 0, -x], [0, 0, -y], [x, y, 0]], dtype=torch.float64)
    return torch.eye(3, dtype=torch.float64) + cross + cross @ cross / (1 + z)
