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
    objects: object id to [M] int64, its Gaussians, ascending. Objects may share Gaussians; those of no object belong to
        the background, 0. None: each Gaussian belongs to its class alone.
    """

    class_ids: Tensor
    objects: Mapping[int, Tensor] | None = None

    def __len__(self) -> int:
        return len(self.class_ids)

    def of(self, class_id: int) -> Tensor:
        """Return [N] bool, the Gaussians of a class."""
        if self.objects is None:
            return self.class_ids == class_id
        inside = torch.zeros_like(self.class_ids, dtype=torch.bool)
        for each in self.objects.values() if class_id == 0 else [self.objects.get(class_id)]:
            if each is not None:
                inside[each.to(inside.device)] = True
        return ~inside if class_id == 0 else inside

    def present(self) -> list[int]:
        """Return the ascending ids of the classes that have Gaussians."""
        if self.objects is None:
            return [int(class_id) for class_id in torch.unique(self.class_ids)]
        background = [0] if bool(self.of(0).any()) else []
        return background + sorted(class_id for class_id, each in self.objects.items() if len(each))

    def __getitem__(self, index: Tensor) -> Membership:
        """Return the membership of the Gaussians ``index`` [M] int64, which may repeat."""
        class_ids = self.class_ids[index]
        if self.objects is None:
            return Membership(class_ids)
        return Membership(class_ids, {c: self.of(c)[index].nonzero()[:, 0] for c in self.objects})

    @classmethod
    def of_masks(cls, masks: Mapping[int, Tensor], class_ids: Tensor) -> Membership:
        """Return the membership of object id to [N] bool; class_ids: [N] int32, phi.

        A Gaussian of several objects keeps its class in phi if that is among them, else gets the lowest of them.
        """
        phi = torch.zeros_like(class_ids)
        for class_id in sorted(masks, reverse=True):
            phi[masks[class_id]] = class_id
        for class_id, mask in masks.items():
            phi[mask & (class_ids == class_id)] = class_id
        return cls(phi, {class_id: mask.nonzero()[:, 0] for class_id, mask in masks.items()})
