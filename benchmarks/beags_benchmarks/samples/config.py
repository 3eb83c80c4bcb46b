"""A sample whose photos differ, or whose masks share errors: the generated scenes that measurements choose by."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial

from beags_benchmarks.samples.damage import degradation_of_degree, flawed_mask, plan_flaws
from beags_benchmarks.samples.exposure import LARGEST_STOPS, Exposed, photo_gains
from beags_benchmarks.samples.visitors import with_visitor
from beags_plugin.sample.degrade import Degradation, lowest_lots
from beags_plugin.sample.family import Family
from beags_plugin.sample.scene import Scene
from beags_plugin.sample.shots import Shot
from beags_plugin.sample.views import View
from beags_plugin.sample.writer import Flawed, SampleConfig
from beags_plugin.system.errors import UserError


@dataclass(frozen=True)
class VariedSample(SampleConfig):
    """Options of a sample; without those of its own it is the same sample as ``SampleConfig``, to the byte.

    degradation: may also be a degree as text ("1.5"). exposure, white_balance: stops, the largest differences of a
    photo from the mean (``photo_gains``). moved: number of training photos in which something of the background stands
    before the camera, in another place in each; no other photo shows it. shared_damage: share of the training masks in
    which half of the objects have the same error each: the mask includes the surface below the object, or lacks its
    foot on one side (``plan_flaws``); ``degradation`` is applied after.
    """

    exposure: float = 0.0
    white_balance: float = 0.0
    moved: int = 0
    shared_damage: float = 0.0

    def check(self) -> None:
        super().check()
        for name in ("exposure", "white_balance"):
            if not 0.0 <= getattr(self, name) <= LARGEST_STOPS:
                raise UserError(
                    f"the sample's {name} is {getattr(self, name)}: give the largest difference of a photo from the "
                    f"mean in stops, from 0 to {LARGEST_STOPS:g}."
                )
        if not 0 <= self.moved <= self.num_train:
            raise UserError(
                f"the sample's moved is {self.moved}: give from 0 to {self.num_train}, the number of training photos."
            )
        if not 0.0 <= self.shared_damage <= 1.0:
            raise UserError(f"the sample's shared_damage is {self.shared_damage}: give a share of views from 0 to 1.")

    def damage(self) -> Degradation:
        if isinstance(self.degradation, str):
            with suppress(ValueError):
                return degradation_of_degree(float(self.degradation))
        return super().damage()

    def shots(self, family: Family, views: list[View]) -> list[Shot]:
        """Return a shot for each view; the seed and the names of the training photos decide which have the visitor."""
        still = family.scene(self.seed)
        light = family.light(still)
        train, held_out = ([view.name for view in views if view.split == split] for split in ("train", "test"))
        visited = lowest_lots(train, self.seed, self.moved, 13)
        gains = photo_gains(train, held_out, self.seed, self.exposure, self.white_balance)
        shots = []
        for view in views:
            scene = with_visitor(still, view, self.seed) if view.name in visited else still
            own = light if scene is still else family.light(scene)
            exposed = own if (gains[view.name] == 1.0).all() else Exposed(own, gains[view.name])
            shots.append(Shot(view, still, scene, own, exposed))
        return shots

    def flaws(self, scene: Scene, train: Sequence[str]) -> Flawed:
        return partial(flawed_mask, flaws=plan_flaws(scene, train, self.seed, self.shared_damage))
