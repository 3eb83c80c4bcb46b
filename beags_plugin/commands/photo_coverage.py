"""What photos show of a demo's result: sides of objects that none shows, veils in photos held out of training."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from beags_plugin.core.surfels import Surfels
    from beags_plugin.objects.evaluate import EvaluatedRun

LEAST = 60  # degrees about an object without a photo that are worth a sentence
NAMED = 6  # photos named in a sentence


@dataclass(frozen=True)
class Coverage:
    """What photos show.

    held_out: number of photos held out of training. veiled: names of those in which something hides the objects that
    the others do not show. unshown: object to how many of the 360 degrees around it no photo shows.
    """

    held_out: int
    veiled: list[str]
    unshown: dict[str, int]

    def figures(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {"veiled": self.veiled, "degrees without photos": self.unshown}

    def lines(self) -> list[str]:
        """Return sentences on what is missing; none if nothing is."""
        lines = []
        if self.veiled:
            names = ", ".join(self.veiled[:NAMED]) + (" ..." if len(self.veiled) > NAMED else "")
            lines.append(
                f"In {len(self.veiled)} of {self.held_out} photos kept out of training ({names}), something hides the "
                "object that photos beside them do not show: more photos from there may remove it."
            )
        lines += [
            f"About {degrees} of the 360 degrees around {name} are in no photo: there its shape is a guess."
            for name, degrees in self.unshown.items()
            if degrees >= LEAST
        ]
        return lines


def coverage(run: EvaluatedRun, objects: Mapping[int, Mapping[str, Surfels]]) -> Coverage:
    """Return what photos show of a finished run.

    objects: id to stage to the object's Gaussians, of which the last stage with any counts.
    """
    from beags_plugin.evaluation.veils import veiled
    from beags_plugin.pictures.orbit import orbit_frame, unshown
    from beags_plugin.surfaces.frames import bounding_box

    cameras, scene = run.views.cameras("train"), run.stages["after"]
    degrees = {}
    for class_id, stages in objects.items():
        whole = [part for part in stages.values() if len(part)]
        if whole:
            stand = orbit_frame(*bounding_box(whole[-1]), cameras)
            degrees[run.classes.get(class_id, f"object {class_id}")] = unshown(stand, cameras)
    held_out = dict(zip(run.views.names, run.views.cameras("eval"), strict=True))
    alone = run.objects_alone  # Then nothing but the objects was trained.
    parts = scene.surfels(), scene.members, list(objects)
    found = [] if alone else veiled(*parts, held_out, cameras, run.rasterizer, run.settings)
    return Coverage(len(held_out), found, degrees)
