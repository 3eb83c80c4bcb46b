"""Which surfels a viewer shows, and which it fades."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from beags_plugin.core.surfels import Surfels, opacities


@dataclass(frozen=True)
class Choice:
    """What of a scene is looked at. Choosing changes nothing of the scene: every method returns another choice.

    hidden: class ids that belong to the rest. removed: class ids that are gone, whatever ``rest`` says.
    isolated: the one class that does not belong to the rest; None: all but the hidden.
    rest: 0..1, what is left of the opacity of the rest; 0 leaves it out.
    min_opacity: 0..1, weaker surfels are left out.
    """

    hidden: frozenset[int] = frozenset()
    removed: frozenset[int] = frozenset()
    isolated: int | None = None
    rest: float = 0.0
    min_opacity: float = 0.0

    def isolate(self, class_id: int) -> Choice:
        """Show this class alone, before the rest."""
        return replace(self.show(class_id), isolated=class_id)

    def hide(self, class_id: int) -> Choice:
        """Let this class be part of the rest."""
        return replace(self.show(class_id), hidden=self.hidden | {class_id}, isolated=self._but(class_id))

    def remove(self, class_id: int) -> Choice:
        """Leave this class out."""
        return replace(self.show(class_id), removed=self.removed | {class_id}, isolated=self._but(class_id))

    def show(self, class_id: int) -> Choice:
        """Show this class again; also the others, if one was isolated that was not this."""
        return replace(
            self, hidden=self.hidden - {class_id}, removed=self.removed - {class_id}, isolated=self._only(class_id)
        )

    def show_all(self) -> Choice:
        """Show every class again."""
        return replace(self, hidden=frozenset(), removed=frozenset(), isolated=None)

    def _but(self, class_id: int) -> int | None:
        return None if self.isolated == class_id else self.isolated

    def _only(self, class_id: int) -> int | None:
        return self.isolated if self.isolated == class_id else None

    def state(self, class_id: int) -> str:
        """What a reader is told of a class: "removed", "hidden" or "shown"."""
        if class_id in self.removed:
            return "removed"
        return "shown" if self.in_full(class_id) else "hidden"

    def in_full(self, class_id: int) -> bool:
        """Whether this class is neither removed nor part of the rest."""
        if class_id in self.removed or class_id in self.hidden:
            return False
        return self.isolated is None or self.isolated == class_id

    @property
    def of_classes(self) -> bool:
        """Whether any class is treated differently from the others."""
        return bool(self.hidden or self.removed or self.isolated is not None)


@dataclass(frozen=True)
class Visible:
    """The surfels that are drawn, with the opacity that they are drawn with.

    index: [M] int64, which of the scene's they are, ascending; None: all of them, as they are.
    """

    surfels: Surfels
    class_ids: Tensor
    index: Tensor | None


@torch.no_grad()
def shown(
    surfels: Surfels, class_ids: Tensor, choice: Choice, rest: bool = True, inside: Tensor | None = None
) -> Visible:
    """What ``choice`` leaves of a scene.

    surfels: N surfels. class_ids: [N] int, phi. rest: whether the rest is drawn at all. inside: [N] bool, the surfels
    of a crop box, or None for all.
    """
    if not choice.of_classes and choice.min_opacity <= 0.0 and inside is None:
        return Visible(surfels, class_ids, None)
    keep = torch.ones(len(surfels), dtype=torch.bool, device=class_ids.device)
    if inside is not None:
        keep &= inside
    if choice.min_opacity > 0.0:
        keep &= opacities(surfels.opacity_logits) >= choice.min_opacity
    fades = _member(class_ids, choice.hidden)
    if choice.isolated is not None:
        fades |= class_ids != choice.isolated
    keep &= ~_member(class_ids, choice.removed)
    left = choice.rest if rest else 0.0
    if left <= 0.0:
        keep &= ~fades
    index = keep.nonzero()[:, 0]
    chosen = surfels[index]
    if 0.0 < left < 1.0:
        chosen = replace(chosen, opacity_logits=_faded(chosen.opacity_logits, fades[index], left))
    return Visible(chosen, class_ids[index], index)


def _member(class_ids: Tensor, members: frozenset[int]) -> Tensor:
    return torch.isin(class_ids, class_ids.new_tensor(sorted(members)))


def _faded(logits: Tensor, fades: Tensor, left: float) -> Tensor:
    """Logits of the opacities times ``left`` where ``fades``; the opacities below 1 / 255 are as good as 0."""
    weaker = left * opacities(logits)
    return torch.where(fades, torch.logit(weaker, eps=1e-6), logits)
