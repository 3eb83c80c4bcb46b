"""Training views and held-out views."""

from __future__ import annotations

from collections.abc import Sequence

from beags_plugin.data.dataset import Split
from beags_plugin.system.errors import UserError, meant


def split_views(
    names: Sequence[set[str]], split: Split, interval: int, held_out: Sequence[str] = ()
) -> tuple[list[int], list[int]]:
    """Return the indices of the training and of the evaluation views; without held-out views, all serve both.

    names: of each view, sorted: the stem of its file, and its name in the poses. interval: of ``Split.every``, counted
    from the first view that is not left out; 0 for none. held_out: names from the user, besides the protocol's.
    Raises ``UserError`` if a name of ``held_out`` does not exist or no view is left to train on.
    """
    known = set().union(*names)
    if unknown := sorted(set(held_out) - known):
        near = meant(unknown[0], known)
        raise UserError(f"held_out names {unknown[0]!r}, but no image has that stem{near}: correct the name.")
    kept = [index for index, own in enumerate(names) if own.isdisjoint(split.left_out)]
    out = set(kept[::interval]) if split.every and interval > 0 else set()
    out |= {index for index in kept if not names[index].isdisjoint(split.held_out)}
    out |= {index for index, own in enumerate(names) if not own.isdisjoint(held_out)}  # left out or not
    train = [index for index in kept if index not in out]
    if not train:
        raise UserError(f"all {len(kept)} views are held out for evaluation: add views or change eval_interval.")
    return train, sorted(out) or train
