"""Objects picked one after another: every step gives another list of them, so that each can be undone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from beags_plugin.core.membership import Membership
from beags_plugin.labels.class_ids import BACKGROUND
from beags_plugin.picking.cutter import Cutter, ViewMarks
from beags_plugin.system.errors import UserError

GROWTH = 0.35  # of one step, in the logit of ``Cutter.solve``: what walks reach with a third less chance comes too
ON_IT = 0.5  # of the light of a mark: it lies on what gives so much


@dataclass(frozen=True)
class Picked:
    """One object, picked or corrected.

    marks: in the order in which they were made. growth: steps of ``GROWTH``. members: [N] bool, what was cut; None
    before the first mark. class_id, start: of the object of a run that is corrected, and its Gaussians before, [N]
    bool; None for a new object.
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
    """The objects, and the place of the one that the next mark is about; every method returns others."""

    objects: tuple[Picked, ...] = (Picked("object 1"),)
    place: int = 0

    @property
    def chosen(self) -> Picked:
        """Return the object that the next mark is about."""
        return self.objects[self.place]

    def marked(self, cutter: Cutter, mark: ViewMarks) -> Picks:
        """Cut the object again, with one more mark; raises ``UserError`` as ``Cutter.solve`` does."""
        return self._cut(cutter, replace(self.chosen, marks=(*self.chosen.marks, mark)))

    def grown(self, cutter: Cutter, steps: int) -> Picks:
        """Cut the object again, larger by so many steps, or smaller; raises ``UserError`` without a mark."""
        if not self.chosen.marks:
            raise UserError(f"nothing of {self.chosen.name} has been picked yet: click on it first.")
        return self._cut(cutter, replace(self.chosen, growth=self.chosen.growth + steps))

    def named(self, name: str) -> Picks:
        """Name the object."""
        return self._with(replace(self.chosen, name=name))

    def another(self) -> Picks:
        """Begin another object, unless there is one that has no mark yet."""
        for place, one in enumerate(self.objects):
            if not one.marks and one.class_id is None:
                return replace(self, place=place)
        names = {one.name for one in self.objects}
        name = next(name for number in range(1, len(names) + 2) if (name := f"object {number}") not in names)
        return Picks((*self.objects, Picked(name)), len(self.objects))

    def correcting(self, name: str, class_id: int, start: Tensor) -> Picks:
        """Go on with an object of the run, whose Gaussians are ``start`` [N] bool."""
        for place, one in enumerate(self.objects):
            if one.class_id == class_id:
                return replace(self, place=place)
        one = Picked(name, members=start, class_id=class_id, start=start)
        return Picks((*self.objects, one), len(self.objects))

    def choose(self, place: int) -> Picks:
        """Go on with another of the objects."""
        return replace(self, place=place)

    def changed(self) -> list[Picked]:
        """Return the objects that were picked or corrected."""
        return [one for one in self.objects if one.changed]

    def applied(self, members: Membership, names: Mapping[int, str]) -> tuple[Membership, dict[int, str]]:
        """Return the classes of N Gaussians once all is picked, and their names.

        members, names: as before. New objects get new ids, or that of a class of their name without Gaussians. What
        several of the picked ones hold is the smallest one's (``_smallest_last``), and what was taken from an object is
        the background's. Raises ``UserError`` if nothing was picked, and for a name that is empty or another object's.
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
                raise UserError("an object has no name: give it one, of plain text on one line.")
            free = [each for each, other in given.items() if other == name and each not in there | set(masks)]
            class_id = (free or [max(given) + 1])[0] if one.class_id is None else one.class_id
            if name in (other for each, other in given.items() if each != class_id):
                raise UserError(f"there are two objects called {name!r}: name one of them otherwise.")
            given[class_id] = name
            masks[class_id] = one.members
        taken = torch.zeros(len(members), dtype=torch.bool)
        for class_id in reversed(_smallest_last(masks)):
            masks[class_id], taken = masks[class_id] & ~taken, taken | masks[class_id]
        return _with_masks(members, masks), given

    def owners(self, count: int) -> Tensor:
        """Return [count] int64, the place of the smallest object that holds each Gaussian; -1: none."""
        found = torch.full((count,), -1, dtype=torch.int64)
        masks = {place: one.members for place, one in enumerate(self.objects) if one.members is not None}
        for place in _smallest_last(masks):
            found[masks[place]] = place
        return found

    def _with(self, one: Picked) -> Picks:
        return replace(self, objects=(*self.objects[: self.place], one, *self.objects[self.place + 1 :]))

    def _cut(self, cutter: Cutter, one: Picked) -> Picks:
        others = [
            replace(mark, inside=(False,) * len(mark.inside), within=None, of_others=True)
            for place, other in enumerate(self.objects)
            for mark in other.marks
            if place != self.place and all(mark.inside)
        ]
        cut = _cut_new if one.start is None else _corrected
        return self._with(replace(one, members=cut(cutter, one, [mark for mark in others if mark.inside])))


def _smallest_last(masks: Mapping[int, Tensor]) -> list[int]:
    """Return the keys of masks [N] bool by falling size, those of one size in their order: the last one wins."""
    return sorted(masks, key=lambda each: -int(masks[each].sum()))


def _cut_new(cutter: Cutter, one: Picked, others: Sequence[ViewMarks]) -> Tensor:
    return cutter.solve([*one.marks, *others], name=one.name, growth=GROWTH * one.growth)


def _corrected(cutter: Cutter, one: Picked, others: Sequence[ViewMarks]) -> Tensor:
    """Return the Gaussians that an object had, without the parts that marks beside it show, and with those on it."""
    assert one.start is not None
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
        raise UserError(f"nothing of {one.name} is there: click on what shall be taken from it.")
    if on:
        members = members | cutter.solve([*one.marks, *others], name=one.name, growth=GROWTH * one.growth)
    members = members & ~outside
    if not members.any():
        raise UserError(f"nothing would be left of {one.name}: take less from it.")
    return members


def _with_masks(members: Membership, masks: Mapping[int, Tensor]) -> Membership:
    """Return the classes once those of ``masks`` (id to [N] bool) are as given."""
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
    kept = {each: index for each, index in members.objects.items() if each not in masks}
    left = {each: index[~taken.to(index.device)[index]] for each, index in kept.items()}
    return Membership(class_ids, left | {each: mask.nonzero()[:, 0] for each, mask in masks.items()})
