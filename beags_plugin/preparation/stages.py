"""Stages that are kept on disk once they are finished, and taken from there while their inputs are the same."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from copy import copy
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor

from beags_plugin.labels.label_maps import LabelMaps, PackedMap, PackedMaps
from beags_plugin.occupancy.grid import VisibilityGrid
from beags_plugin.system.digests import input_digest
from beags_plugin.system.filed_tensors import FiledTensors, filed, write_tensors
from beags_plugin.system.processes import in_any, is_first
from beags_plugin.system.reading.tensors import load_tensors
from beags_plugin.system.whole_files import write_whole

FORMAT = 2
"""Of the files below; another number makes every stage be done again."""

T = TypeVar("T")


class StageStore:
    """Results of stages: files ``<name>-<digest>.pt`` in ``folder``, one for each name; whole ones only.

    Tensors too large for memory lie in ``<name>-<digest>.npz``.

    former: folders of runs that this one goes on from, looked into too, but not written to.
    """

    def __init__(self, folder: Path, former: Sequence[Path] = ()) -> None:
        self.folder = folder
        self.former = former

    def kept(self, name: str, digest: str) -> Any | None:
        """What was kept of the stage with these inputs; None if it is not there or cannot be read."""
        for folder in (self.folder, *self.former):
            try:
                return load_tensors(_file(folder, name, digest))
            except (OSError, ValueError):  # not there, or damaged: the stage is done again
                continue
        return None

    def keep(self, name: str, digest: str, content: Any) -> None:
        """Keep the stage's content (tensors and plain values) in place of what was there of it."""
        path = _file(self.folder, name, digest)
        write_whole(path, lambda file: torch.save(content, file))
        self._remove_but(path, name)

    def kept_tensors(self, name: str, digest: str, device: torch.device | str) -> FiledTensors | None:
        """What was kept of the stage by ``keep_tensors``; None if it is not there or cannot be read."""
        for folder in (self.folder, *self.former):
            with suppress(OSError, ValueError, EOFError):  # an empty file ends early
                return FiledTensors(_file(folder, name, digest, ".npz"), device)
        return None

    def keep_tensors(
        self, name: str, digest: str, tensors: Iterable[Tensor], device: torch.device | str
    ) -> FiledTensors:
        """Keep tensors, one by one as they come, in place of what was there of the stage; read them from there."""
        path = _file(self.folder, name, digest, ".npz")
        write_whole(path, lambda file: write_tensors(file, tensors))
        self._remove_but(path, name)
        return FiledTensors(path, device)

    def drop(self, name: str) -> None:
        """Forget the stage."""
        self._remove_but(None, name)

    def _remove_but(self, kept: Path | None, name: str) -> None:
        for suffix in (".pt", ".npz"):
            for other in self.folder.glob(f"{name}-*{suffix}"):
                if other != kept:
                    other.unlink()


def _file(folder: Path, name: str, digest: str, suffix: str = ".pt") -> Path:
    return folder / f"{name}-{digest[:24]}{suffix}"


class Form(Generic[T]):
    """How a stage's result lies on disk: ``pack`` makes tensors and plain values of it, ``unpack`` the result again."""

    def __init__(self, pack: Callable[[T], Any], unpack: Callable[[Any], T]) -> None:
        self.pack = pack
        self.unpack = unpack


def moved(value: Any, device: torch.device) -> Any:
    """A stage's result with all its tensors there; packed ones come from the CPU."""
    if device.type == "cpu":
        return value
    if isinstance(value, (Tensor, VisibilityGrid)):
        return value.to(device)
    if isinstance(value, (PackedMap, LabelMaps, PackedMaps)):
        elsewhere = copy(value)
        if isinstance(elsewhere, PackedMap):
            elsewhere.device = device
        else:
            elsewhere.stored = moved(elsewhere.stored, device)
        return elsewhere
    if isinstance(value, (list, tuple)):
        return type(value)(moved(part, device) for part in value)
    if is_dataclass(value) and not isinstance(value, type):
        return replace(value, **{field.name: moved(getattr(value, field.name), device) for field in fields(value)})
    return value


class Stages:
    """The stages of one preparation, in order: each depends on its own inputs and on all that came before.

    inputs: what every stage depends on; see ``digests.input_digest``. store: where to keep them; None keeps nothing.
    device: where results are computed, and brought to when they were kept.
    """

    def __init__(self, store: StageStore | None, *inputs: Any, device: torch.device | str = "cpu") -> None:
        self.store = store
        self.device = torch.device(device)
        self.findings: list[str] = []
        self.seconds: dict[str, float] = {}
        self._digest = "" if store is None else input_digest(FORMAT, *inputs)
        self._aside = 0.0  # seconds that went into files, less those that stages took when they were computed
        self._reused: set[str] = set()

    def key(self, name: str, *inputs: Any) -> str:
        """The digest of the next stage's inputs."""
        if self.store is not None:
            self._digest = input_digest(self._digest, name, *inputs)
        return self._digest

    def run(self, name: str, key: str, compute: Callable[[], T], form: Form[T]) -> T:
        """The stage's result, computed, or from the store if it was computed with the same ``key`` before."""
        start, aside = time.perf_counter(), self._aside
        kept = None if self.store is None else self.store.kept(name, key)
        if not in_any(kept is None) and kept is not None:  # several processes go the same way
            self._reused.add(name)
            self.seconds[name] = kept["seconds"]
            self._aside += time.perf_counter() - start - kept["seconds"]
            return moved(form.unpack(kept["content"]), self.device)
        found = compute()
        self.seconds[name] = time.perf_counter() - start - (self._aside - aside)
        if self.store is not None and is_first():  # of several processes, one writes to the run's folder
            start = time.perf_counter()
            self.store.keep(name, key, {"seconds": self.seconds[name], "content": form.pack(found)})
            self._aside += time.perf_counter() - start
        return found

    def run_filed(
        self, name: str, key: str, compute: Callable[[], Iterable[Tensor]], device: torch.device | str
    ) -> Sequence[Tensor]:
        """The stage's tensors, which never are in memory together: in the store, or without one in a temporary file.

        compute: gives them one by one. device: where those that are asked for are put.
        """
        start = time.perf_counter()

        def timed() -> Iterator[Tensor]:
            yield from compute()
            self.seconds[name] = time.perf_counter() - start
            yield torch.tensor(self.seconds[name], dtype=torch.float64)  # the last one: what the stage took

        kept = None if self.store is None else self.store.kept_tensors(name, key, device)
        if not in_any(kept is None) and kept is not None:
            self._reused.add(name)
            self.seconds[name] = float(kept[-1])
            self._aside += time.perf_counter() - start - self.seconds[name]
            return _AllButLast(kept)
        if self.store is None or not is_first():
            return _AllButLast(filed(timed(), device))
        return _AllButLast(self.store.keep_tensors(name, key, timed(), device))

    def drop(self, name: str) -> None:
        """Forget a stage that nothing asks for again; its seconds are part of another's."""
        self.seconds.pop(name, None)
        if self.store is not None and is_first():
            self.store.drop(name)

    def found(self, name: str, finding: str) -> None:
        """Note a line for a reader."""
        self.findings.append(f"{finding} (kept from before)" if name in self._reused else finding)


class _AllButLast(Sequence[Tensor]):
    """A sequence without its last item, which is not copied."""

    def __init__(self, whole: Sequence[Tensor]) -> None:
        self._whole = whole

    def __len__(self) -> int:
        return len(self._whole) - 1

    def __getitem__(self, index: int | slice) -> Any:
        chosen = range(len(self))[index]
        return self._whole[chosen] if isinstance(chosen, int) else [self._whole[each] for each in chosen]
