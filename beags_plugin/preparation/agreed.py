"""Make the masks of all views agree in space (``masks.agreement``), and report what that changed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
import torch

from beags_plugin.core.cameras import Camera
from beags_plugin.core.surfels import Surfels
from beags_plugin.labels.class_ranks import ClassRanks
from beags_plugin.labels.label_maps import LabelMaps
from beags_plugin.masks.agreement import AgreedMask, agreed_masks, decide
from beags_plugin.masks.separate_things import Things, separate, separated_labels
from beags_plugin.preparation.consistent_masks import Stage, translated
from beags_plugin.rasterizers.interface import Rasterizer, RasterSettings

NAMED = 6  # Views named in a sentence.


@dataclass(frozen=True)
class AgreementReport:
    """What agreement did to the masks of V views.

    errors: [V], share on which a view contradicts the others, of the pixels that either calls an object; None without
    a mask, and where neither does. overruled: views whose masks are more wrong than right and were redrawn whole.
    changed, doubtful: [V], shares of pixels that got another class, and that were left unlabelled. things: the parts
    that one object was split into; None if it was not. misplaced: views whose masks stayed, because their poses rather
    than these contradict the others.
    """

    errors: list[float | None]
    overruled: list[int]
    changed: list[float]
    doubtful: list[float]
    things: Things | None = None
    misplaced: list[int] = field(default_factory=list)

    @property
    def agreement(self) -> float:
        """Return the mean share of the objects on which a view and the others agree, 0..1; 1 without an object."""
        known = [1.0 - error for error in self.errors if error is not None]
        return float(np.mean(known)) if known else 1.0

    def of_first(self, count: int) -> AgreementReport:
        """Return what it did to the first ``count`` views."""
        overruled, misplaced = ([view for view in views if view < count] for views in (self.overruled, self.misplaced))
        errors, changed, doubtful = self.errors[:count], self.changed[:count], self.doubtful[:count]
        return AgreementReport(errors, overruled, changed, doubtful, self.things, misplaced)

    def to_json(self, names: Sequence[str]) -> dict[str, Any]:
        """Return plain values for JSON; names: of the views. "masks" counts those that have an error."""
        rows = zip(names, self.errors, self.changed, self.doubtful, strict=True)
        return {
            **({} if self.things is None else {"things": asdict(self.things)}),
            "agreement": round(self.agreement, 4),
            "masks": sum(error is not None for error in self.errors),
            "overruled": [names[view] for view in self.overruled],
            "misplaced": [names[view] for view in self.misplaced],
            "changed": round(float(np.mean(self.changed)), 5),
            "doubtful": round(float(np.mean(self.doubtful)), 5),
            "views": [
                {"view": name, "contradicts": error, "changed": round(changed, 5), "doubtful": round(doubtful, 5)}
                for name, error, changed, doubtful in rows
            ],
        }

    def sentence(self, names: Sequence[str] | None = None) -> str:
        """Return a line for users; with the names of the views it also names the overruled ones."""
        count = sum(error is not None for error in self.errors)
        line = f"the views agree on {100 * self.agreement:.0f} % of what they call an object"
        if self.overruled:
            were = "was" if len(self.overruled) == 1 else "were"
            line += f"; {len(self.overruled)} of {count} masks {were} overruled as a whole"
            line += "" if names is None else _named(self.overruled, names)
        if self.misplaced:
            line += f"; the photos of {len(self.misplaced)} of {count} masks seem to have wrong poses"
            line += "" if names is None else _named(self.misplaced, names)
        changed, doubtful = (100 * float(np.mean(share)) for share in (self.changed, self.doubtful))
        return f"{line}; {changed:.2f} % of all pixels got another class, {doubtful:.2f} % are in doubt"


def _named(views: Sequence[int], names: Sequence[str]) -> str:
    """Return the names of the first of these views, in brackets."""
    rest = len(views) - NAMED
    return f" ({', '.join(names[view] for view in views[:NAMED])}{f' and {rest} more' if rest > 0 else ''})"


def agree(
    surfels: Surfels,
    cameras: Sequence[Camera],
    maps: LabelMaps,
    known: ClassRanks,
    rasterizer: Rasterizer,
    settings: RasterSettings,
    stage: Stage,
    reach: int = 1,
    photos: Sequence[Callable[[], np.ndarray]] | None = None,
    take: Callable[[int, AgreedMask], None] = lambda view, mask: None,
    things: int = 1,
) -> tuple[LabelMaps, AgreementReport]:
    """Return labels (class ids) of V views that agree with one class per Gaussian, and what that changed.

    known: the classes. take: receives the index of each view and its mask, in ranks of ``known``. things: if above 1,
    the one object is split into at most so many separate things, whose ids are 1, 2, ... The other arguments are those
    of ``masks.agreement``.
    """
    given = translated(maps, known, known.ranks)
    with stage("Weighing masks") as progress:
        agreement = decide(surfels, cameras, given, rasterizer, settings, len(known), progress)
    split = None
    if things > 1:
        split = separate(agreement, surfels, things)
        given = LabelMaps(separated_labels(split, surfels, cameras, given, rasterizer, settings))
        agreement, known = split.agreement, ClassRanks(torch.arange(split.things.found + 1))
    ranked, changed, doubtful, misplaced = LabelMaps(), [], [], []
    with stage("Drawing agreed masks") as progress:
        masks = agreed_masks(agreement, surfels, cameras, given, rasterizer, settings, len(known), reach, photos)
        for view, mask in enumerate(masks):
            take(view, mask)
            ranked.append(mask.labels)
            changed.append(float(mask.changed.float().mean()) if given.stored[view] is not None else 0.0)
            doubtful.append(float(mask.doubtful.float().mean()))
            misplaced += [view] if mask.misplaced else []
            if progress is not None:
                progress(view + 1, len(cameras))
    errors = [None if np.isnan(error) else round(float(error), 4) for error in agreement.errors]
    overruled, found = sorted(set(agreement.silenced) - set(misplaced)), None if split is None else split.things
    report = AgreementReport(errors, overruled, changed, doubtful, found, misplaced)
    return translated(ranked, known, known.class_ids), report
