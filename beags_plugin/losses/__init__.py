"""The losses, each a registered component (entry points: ``beags.losses``)."""

from __future__ import annotations

import math
from dataclasses import fields
from typing import TYPE_CHECKING, get_args

from beags_plugin.core.schedule import PhaseSchedule
from beags_plugin.system.errors import UserError, check_choice
from beags_plugin.system.registry import Registry

if TYPE_CHECKING:
    from beags_plugin.losses.base import Loss
    from beags_plugin.options.loss_spec import LossSpec

LOSSES = Registry(
    "loss",
    "beags.losses",
    {
        "photometric": "beags_plugin.losses.photometric:PhotometricLoss",
        "normal": "beags_plugin.losses.normal:NormalConsistencyLoss",
        "distortion": "beags_plugin.losses.distortion:DistortionLoss",
        "boundary": "beags_plugin.losses.boundary:BoundaryLoss",
        "silhouette": "beags_plugin.losses.silhouette:SilhouetteLoss",
        "occupancy": "beags_plugin.losses.occupancy:OccupancyLoss",
    },
)


def make_loss(name: str, spec: LossSpec, schedule: PhaseSchedule) -> Loss:
    """Return the loss called ``name``, with absolute steps; raises ``UserError`` for a wrong value."""
    from beags_plugin.options.loss_spec import Phase

    kind = LOSSES.get(name)
    if not 0.0 <= spec.weight < math.inf:
        raise UserError(f"the loss {name} has the weight {spec.weight}: give 0 (off) or more.")
    check_choice(spec.phase, get_args(Phase), "phase", f" of the loss {name}")
    if spec.start < 0:
        raise UserError(f"the loss {name} starts at step {spec.start}: give 0 or more.")
    known = [field.name for field in fields(kind) if field.name not in ("weight", "start", "stop")]
    for option in spec.options:
        check_choice(option, known, "option", f" of the loss {name}")
    first = schedule.base_steps + spec.start if spec.phase == "refine" else schedule.scaled(spec.start)
    if spec.phase != "refine" and (schedule.base_steps == 0 or schedule.warm):
        first = 0  # The base was trained elsewhere, so its terms have long started.
    last = schedule.base_steps if spec.phase == "base" else None
    return kind(weight=spec.weight, start=first, stop=last, **spec.options)
