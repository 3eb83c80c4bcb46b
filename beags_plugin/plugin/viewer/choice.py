"""Choice of the Gaussians that a viewer shows or fades."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from beags_plugin.core.membership import Membership
from beags_plugin.core.surfels import Surfels, opacities


@dataclass(frozen=True)
class Choice:
    """The parts of a scene to look at; every method returns a new choice and leaves the scene alone.

    hidden: class ids that belong to the rest. removed: class ids that are left out, whatever ``faded_opacity`` is.
    isolated: the one class outside the rest; None: all but the hidden ones. faded_opacity: 0..1, factor of the rest's
    opacity; 0 leaves the rest out. min_opacity: 0..1, weaker Gaussians are left out.
    """

    hidden: frozenset[int] = frozenset()
    removed: frozenset[int] = frozenset()
    isolated: int | None = None
    faded_opacity: float = 0.0
    min_opacity: float = 0.0

    def isolate(self, class_id: int) -> Choice:
        """Show this class alone, before the rest."""
        return replace(self.show(class_id), isolated=class_id)

    def hide(self, class_id: int) -> Choice:
        """Make this class part of the rest."""
        isolated = None if self.isolated == class_id else self.isolated
        return replace(self.show(class_id), hidden=self.hidden | {class_id}, isolated=isolated)

    def remove(self, class_id: int) -> Choice:
        """Leave this class out."""
        isolated = None if self.isolated == class_id else self.isolated
        return replace(self.show(class_id), removed=self.removed | {class_id}, isolated=isolated)

    def show(self, class_id: int) -> Choice:
        """Show this class again; if another one was isolated, show the others too."""
        isolated = class_id if self.isolated == class_id else None
        return replace(self, hidden=self.hidden - {class_id}, removed=self.removed - {class_id}, isolated=isolated)

    def after(self, action: str, class_id: int) -> Choice:
        """Apply a button of the panel: "Isolate", "Show", "Hide" or "Remove"."""
        change = {"Isolate": self.isolate, "Show": self.show, "Hide": self.hide, "Remove": self.remove}
        return change[action](class_id)

    def show_all(self) -> Choice:
        """Show every class again."""
        return replace(self, hidden=frozenset(), removed=frozenset(), isolated=None)

    def state(self, class_id: int) -> str:
        """Return "removed", "hidden" or "shown", for the legend."""
        if class_id in self.removed:
            return "removed"
        return "shown" if self.in_full(class_id) else "hidden"

    def in_full(self, class_id: int) -> bool:
        """Return whether this class is neither removed nor part of the rest."""
        if class_id in self.removed or class_id in self.hidden:
            return False
        return self.isolated is None or self.isolated == class_id

    def title(self, names: Mapping[int, str]) -> str:
        """Return the shown part in a few words, for a file's name; names: of the classes that have Gaussians."""
        if self.isolated is not None:
            return f"shown_{names.get(self.isolated, f'class_{self.isolated}')}"
        away = [name for class_id, name in names.items() if not self.in_full(class_id)]
        return f"shown_without_{'_'.join(away[:3])}" if away else "shown_scene"

    @property
    def of_classes(self) -> bool:
        """Return whether any class is treated differently from the others."""
        return bool(self.hidden or self.removed or self.isolated is not None)


@dataclass(frozen=True)
class Visible:
    """The Gaussians that are rendered, with their opacity in the picture.

    index: [M] int64, their indices in the scene, ascending; None: all of them, as they are.
    """

    surfels: Surfels
    class_ids: Tensor
    index: Tensor | None


@torch.no_grad()
def visible_part(
    surfels: Surfels, members: Membership, choice: Choice, rest: bool = True, inside: Tensor | None = None
) -> Visible:
    """Return the part of a scene that ``choice`` leaves.

    surfels: N Gaussians. members: of them. rest: False leaves the rest out. inside: [N] bool, the Gaussians of a
    crop box, or None for all.
    """
    if not choice.of_classes and choice.min_opacity <= 0.0 and inside is None:
        return Visible(surfels, members.class_ids, None)
    keep = torch.ones(len(surfels), dtype=torch.bool, device=members.class_ids.device)
    if inside is not None:
        keep &= inside
    if choice.min_opacity > 0.0:
        keep &= opacities(surfels.opacity_logits) >= choice.min_opacity
    fades = _of_any(members, choice.hidden)
    if choice.isolated is not None:
        fades |= ~members.of(choice.isolated)
    keep &= ~_of_any(members, choice.removed)
    opacity = choice.faded_opacity if rest else 0.0
    if opacity <= 0.0:
        keep &= ~fades
    index = keep.nonzero()[:, 0]
    chosen = surfels[index]
    if 0.0 < opacity < 1.0:
        faded = torch.logit(opacity * opacities(chosen.opacity_logits), eps=1e-6)  # Less than 1 / 255 is invisible.
        chosen = replace(chosen, opacity_logits=torch.where(fades[index], faded, chosen.opacity_logits))
    class_ids = members.class_ids[index]
    if choice.isolated is not None and members.objects is not None:  # Shared Gaussians may have another class.
        class_ids = torch.where(members.of(choice.isolated)[index], choice.isolated, class_ids)
    return Visible(chosen, class_ids, index)


def _of_any(members: Membership, classes: frozenset[int]) -> Tensor:
    """Return [N] bool, the Gaussians of any of the classes."""
    if members.objects is None:
        return torch.isin(members.class_ids, members.class_ids.new_tensor(sorted(classes)))
    inside = torch.zeros_like(members.class_ids, dtype=torch.bool)
    for class_id in classes:
        inside |= members.of(class_id)
    return inside
