"""Objects picked one after another; every step returns a new list of them, so that each can be undone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from beags_plugin.core.membership import Membership
from beags_plugin.labels.class_ids import BACKGROUND
from beags_plugin.picking.cutter import Cutter, ViewMarks
from beags_plugin.system.errors import UserError

GROWTH = 0.35  # growth of one step, in the logit of ``Cutter.solve``: it adds what walks reach a third less often
ON_IT = 0.5  # least share of a mark's light that an object gives if the mark lies on it


@dataclass(frozen=True)
class Picked:
    """One object, picked or corrected.

    marks: in the order in which they were made. growth: steps of ``GROWTH``. members: [N] bool, the cut; None before
    the first mark. class_id: of the run's object that is corrected; None for a new object. start: [N] bool, the
    Gaussians of that object before; None for a new object.
    """

    name: str
    marks: tuple[ViewMarks, ...] = ()
    growth: int = 0
    members: Tensor | None = None
    class_id: int | None = None
    start: Tensor | None = None

    @property
    def changed(self) -> bool:
        """Return whether anything was picked or corrected."""
        return self.members is not None and bool(self.marks)


@dataclass(frozen=True)
class Picks:
    """The objects, and the place of the one that the next mark belongs to; every method returns new ``Picks``."""

    objects: tuple[Picked, ...] = (Picked("object 1"),)
    place: int = 0

    @property
    def chosen(self) -> Picked:
        """Return the object that the next mark belongs to."""
        return self.objects[self.place]

    def marked(self, cutter: Cutter, mark: ViewMarks) -> Picks:
        """Cut the object again, with one more mark; raise ``UserError`` as ``Cutter.solve`` does."""
        return self._cut(cutter, replace(self.chosen, marks=(*self.chosen.marks, mark)))

    def grown(self, cutter: Cutter, steps: int) -> Picks:
        """Cut the object again, larger by some steps, or smaller; raise ``UserError`` without a mark."""
        if not self.chosen.marks:
            raise UserError(f"nothing of {self.chosen.name} has been picked yet: click on it first.")
        return self._cut(cutter, replace(self.chosen, growth=self.chosen.growth + steps))

    def named(self, name: str) -> Picks:
        """Name the object."""
        return self._with(replace(self.chosen, name=name))

    def another(self) -> Picks:
        """Begin another object, or go on with one that has no mark yet."""
        for place, one in enumerate(self.objects):
            if not one.marks and one.class_id is None:
                return replace(self, place=place)
        names = {one.name for one in self.objects}
        name = next(name for number in range(1, len(names) + 2) if (name := f"object {number}") not in names)
        return Picks((*self.objects, Picked(name)), len(self.objects))

    def correcting(self, name: str, class_id: int, start: Tensor) -> Picks:
        """Correct an object of the run, whose Gaussians are ``start`` [N] bool."""
        for place, one in enumerate(self.objects):
            if one.class_id == class_id:
                return replace(self, place=place)
        one = Picked(name, members=start, class_id=class_id, start=start)
        return Picks((*self.objects, one), len(self.objects))

    def choose(self, place: int) -> Picks:
        """Choose another object."""
        return replace(self, place=place)

    def changed(self) -> list[Picked]:
        """Return the objects that were picked or corrected."""
        return [one for one in self.objects if one.changed]

    def applied(self, members: Membership, names: Mapping[int, str]) -> tuple[Membership, dict[int, str]]:
        """Return the classes of N Gaussians after picking, and the classes' names.

        members, names: before picking. A new object gets a new id, or that of a class of its name without Gaussians.
        Gaussians of several picked objects go to the smallest one (``_smallest_last``); those taken from an object
        become background. Raises ``UserError`` if nothing was picked, and for an empty or repeated name.
        """
        changed = self.changed()
        if not changed:
            raise UserError("nothing has been picked yet: tick Click to pick, and click on an object.")
        given = {BACKGROUND: "background", **names}
        there = {BACKGROUND, *members.present()}
        masks: dict[int, Tensor] = {}
        for one in changed:
            assert one.members is not None
            name = one.name.strip()
            if not name or not name.isprintable():
                raise UserError("an object has no name: give it one line of plain text.")
            free = [each for each, other in given.items() if other == name and each not in there | set(masks)]
            class_id = (free or [max(given) + 1])[0] if one.class_id is None else one.class_id
            if name in (other for each, other in given.items() if each != class_id):
                raise UserError(f"there are two objects called {name!r}: rename one of them.")
            given[class_id] = name
            masks[class_id] = one.members
        taken = torch.zeros(len(members), dtype=torch.bool)
        for class_id in reversed(_smallest_last(masks)):
            masks[class_id], taken = masks[class_id] & ~taken, taken | masks[class_id]
        return _with_masks(members, masks), given

    def owners(self, count: int) -> Tensor:
        """Return the place of the smallest object that holds each of ``count`` Gaussians, [N] int64; -1 for none."""
        owners = torch.full((count,), -1, dtype=torch.int64)
        masks = {place: one.members for place, one in enumerate(self.objects) if one.members is not None}
        for place in _smallest_last(masks):
            owners[masks[place]] = place
        return owners

    def _with(self, one: Picked) -> Picks:
        return replace(self, objects=(*self.objects[: self.place], one, *self.objects[self.place + 1 :]))

    def _cut(self, cutter: Cutter, one: Picked) -> Picks:
        others = [
            replace(mark, inside=(False,) * len(mark.inside), within=None, of_others=True)
            for place, other in enumerate(self.objects)
            for mark in other.marks
            if place != self.place and all(mark.inside)
        ]
        others = [mark for mark in others if mark.inside]
        return self._with(replace(one, members=_members(cutter, one, others)))


def _smallest_last(masks: Mapping[int, Tensor]) -> list[int]:
    """Return the keys of masks [N] bool by descending size, equal ones in their order."""
    return sorted(masks, key=lambda each: -int(masks[each].sum()))


def _members(cutter: Cutter, one: Picked, others: Sequence[ViewMarks]) -> Tensor:
    """Return the Gaussians of an object [N] bool.

    A corrected object loses the parts shown by marks beside it, and gains those shown by marks on it.
    """

    def added() -> Tensor:
        return cutter.solve([*one.marks, *others], name=one.name, growth=GROWTH * one.growth)

    if one.start is None:
        return added()
    members = one.start
    on = [mark for mark in one.marks if any(mark.inside)]
    beside = [mark for mark in one.marks if mark.inside and not any(mark.inside)]
    outside = cutter.outside(one.marks)
    if taking := [mark for mark in beside if cutter.shown_share(mark, members) >= ON_IT]:
        flipped = [
            replace(mark, inside=tuple(not each for each in mark.inside), within=None) for mark in (*taking, *on)
        ]
        name = f"what is taken from {one.name}"
        members = members & ~cutter.solve(flipped, ~members, name, -GROWTH * one.growth, part=True)
    elif not on and not bool((outside & members).any()):
        raise UserError(f"nothing of {one.name} is there: click on the part that you want to take from it.")
    if on:
        members = members | added()
    members = members & ~outside
    if not members.any():
        raise UserError(f"nothing would be left of {one.name}: take less from it.")
    return members


def _with_masks(members: Membership, masks: Mapping[int, Tensor]) -> Membership:
    """Return the classes with the Gaussians of ``masks`` (id to [N] bool) replaced."""
    device = members.class_ids.device
    taken = torch.stack([mask.to(device) for mask in masks.values()]).any(dim=0)
    class_ids = torch.where(
        torch.isin(members.class_ids, members.class_ids.new_tensor(list(masks))), BACKGROUND, members.class_ids
    )
    for class_id, mask in masks.items():
        class_ids = torch.where(mask.to(device), class_id, class_ids)
    class_ids = class_ids.to(members.class_ids.dtype)
    if members.objects is None:
        return Membership(class_ids)
    others = {
        each: index[~taken.to(index.device)[index]] for each, index in members.objects.items() if each not in masks
    }
    return Membership(class_ids, others | {each: mask.nonzero()[:, 0] for each, mask in masks.items()})
