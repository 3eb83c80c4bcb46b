"""Detection of scales and opacities written after activation: lengths instead of logs, 0..1 instead of logits.

No specification of splat .ply files forbids that. The value ranges show it: logits of a trained scene exceed 0..1, and
logs of scales below one unit of length are negative.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from beags_plugin.core.flattening import Gaussians
from beags_plugin.system.errors import UserError

StartValues = Literal["auto", "logs", "activated"]

_ENOUGH = 32  # different opacities whose range is no accident
_SAMPLE = 4096  # Gaussians whose nearest neighbours are searched
_FITTING = (0.02, 50.0)  # bounds of median scale / median distance to the nearest neighbour in trained scenes
_MOST_LOGIT = 40.0  # larger logits give an opacity of 1 in double precision
_SPREAD = 0.3  # least standard deviation of the logs of a trained scene's scales
THINNEST = 1e-12  # units of length; stands for scales of 0, such as the third of discs


def stored_values(path: Path, gaussians: Gaussians, values: StartValues) -> tuple[Gaussians, tuple[str, ...]]:
    """Return the Gaussians with logs of scales and logits of opacities, and sentences on what was converted.

    gaussians: N, with scales and opacities as in ``path``. Raises ``UserError`` if ``values`` is "auto" and the ranges
    fit both or neither.
    """
    if values == "logs":
        return gaussians, ()
    if values == "activated":
        scales, opacities = True, True
    else:
        _check_opacities(path, gaussians)
        opacities = _opacities_activated(gaussians)
        scales = _scales_activated(path, gaussians, opacities)
        opacities = opacities and (scales or len(_finite(gaussians.opacity_logits).unique()) >= _ENOUGH)
    converted = " and ".join(name for name, active in (("scales", scales), ("opacities", opacities)) if active)
    if not converted:
        return gaussians, ()
    if scales:
        gaussians = replace(gaussians, log_scales=gaussians.log_scales.clamp_min(THINNEST).log())
    if opacities:
        gaussians = replace(gaussians, opacity_logits=torch.logit(gaussians.opacity_logits.clamp(0.0, 1.0)))
    if values == "activated":
        return gaussians, ()
    return gaussians, (
        f"Its {converted} lie where activated values do, so they are converted "
        "(--pipeline.model.start-values logs takes them as logs and logits).",
    )


def _finite(values: Tensor) -> Tensor:
    return values[values.isfinite()]


def _check_opacities(path: Path, gaussians: Gaussians) -> None:
    """Raise ``UserError`` for opacities in percent or in 0..255."""
    values = _finite(gaussians.opacity_logits)
    if len(values) and bool((values >= 0).all()) and float(values.max()) > _MOST_LOGIT:
        raise UserError(
            f"the opacities of {path} lie in 0..{float(values.max()):g}, where neither logits nor shares of 1 do: "
            "divide them by 100 or 255 where the file was made, or take them as logits with "
            "--pipeline.model.start-values logs."
        )


def _opacities_activated(gaussians: Gaussians) -> bool:
    values = _finite(gaussians.opacity_logits)
    return len(values) > 0 and bool(((values >= 0) & (values <= 1)).all())


def _scales_activated(path: Path, gaussians: Gaussians, opacities: bool) -> bool:
    """Return whether the scales are lengths; opacities: whether the opacities may be activated.

    All logs of a scene are positive if its unit is far smaller than its Gaussians, such as the millimetre. Two
    properties then tell lengths from logs: Gaussians are about as large as the distances between neighbours, and their
    sizes differ, while small lengths taken as logs would give round Gaussians of equal size.
    """
    values = _finite(gaussians.log_scales)
    if len(values) == 0 or bool((values < 0).any()):
        return False
    if opacities:
        return True
    apart = _spacing(gaussians.means)
    if not apart > 0:
        return False
    fits = {}
    for kind, logs in (("lengths", gaussians.log_scales.clamp_min(THINNEST).log()), ("logs", gaussians.log_scales)):
        middle = float(_finite(logs[:, :2].amax(dim=1)).median())
        near = _FITTING[0] < math.exp(min(middle, 700.0)) / apart < _FITTING[1]
        fits[kind] = near and float(_finite(logs[:, :2]).std()) > _SPREAD
    if fits["lengths"] and fits["logs"]:
        raise UserError(
            f"the scales of {path} are all positive and fit both as logs and as lengths: say which with "
            "--pipeline.model.start-values logs or activated."
        )
    return fits["lengths"]


def _spacing(means: Tensor) -> float:
    """Return the median distance from a Gaussian to its nearest neighbour; 0 for fewer than two."""
    from scipy.spatial import KDTree

    points = means[means.isfinite().all(dim=1)].double().cpu().numpy()
    if len(points) < 2:
        return 0.0
    chosen = np.random.default_rng(0).choice(len(points), min(_SAMPLE, len(points)), replace=False)
    return float(np.median(KDTree(points).query(points[chosen], 2)[0][:, 1]))
