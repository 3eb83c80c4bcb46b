"""Which Gaussians belong to which object."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Membership:
    """Which of N Gaussians belong to which class.

    class_ids: [N] int32, phi, the one class in which a viewer shows each Gaussian.
    objects: object id to [M] int64, its Gaussians, ascending; they may share Gaussians and leave some to nobody. The
        background's, 0, are then those of no object. None: each Gaussian belongs to its class alone.
    """

    class_ids: Tensor
    objects: Mapping[int, Tensor] | None = None

    def __len__(self) -> int:
        return len(self.class_ids)

    def of(self, class_id: int) -> Tensor:
        """Return [N] bool, the Gaussians of a class."""
        if self.objects is None:
            return self.class_ids == class_id
        found = torch.zeros_like(self.class_ids, dtype=torch.bool)
        for each in self.objects.values() if class_id == 0 else [self.objects.get(class_id)]:
            if each is not None:
                found[each.to(found.device)] = True
        return ~found if class_id == 0 else found

    def present(self) -> list[int]:
        """Return the ascending ids of the classes that have Gaussians."""
        if self.objects is None:
            return [int(class_id) for class_id in torch.unique(self.class_ids)]
        background = [0] if bool(self.of(0).any()) else []
        return background + sorted(class_id for class_id, each in self.objects.items() if len(each))

    def __getitem__(self, index: Tensor) -> Membership:
        """Return that of the Gaussians ``index`` [M] int64 alone, some of them perhaps repeated."""
        class_ids = self.class_ids[index]
        if self.objects is None:
            return Membership(class_ids)
        return Membership(class_ids, {c: self.of(c)[index].nonzero()[:, 0] for c in self.objects})

    @classmethod
    def of_masks(cls, masks: Mapping[int, Tensor], class_ids: Tensor) -> Membership:
        """Return that of object id to [N] bool; class_ids: [N] int32, phi.

        A Gaussian of several objects is shown in phi if that is among them, else in the lowest of them.
        """
        shown = class_ids.clone()
        inside = torch.zeros_like(shown, dtype=torch.bool)
        for class_id in sorted(masks, reverse=True):
            mask = masks[class_id]
            inside |= mask
            shown[mask & (class_ids != class_id)] = class_id
        for class_id, mask in masks.items():
            shown[mask & (class_ids == class_id)] = class_id
        shown[~inside] = 0
        return cls(shown, {class_id: mask.nonzero()[:, 0] for class_id, mask in masks.items()})
