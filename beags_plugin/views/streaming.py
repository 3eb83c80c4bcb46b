"""Views read from disk when needed, some ahead of use, so that memory does not grow with their number."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from beags_plugin.labels.label_maps import CompressedMap

Load = Callable[[int], dict[str, Any]]


class StreamedViews(Sequence[dict[str, Any]]):
    """The data of V views, each loaded when it is used, or before if it is expected; none is stored.

    load: returns the data of a view; threads call it. ahead: number of views loaded before their use. workers: number
    of threads. labels: of all views; if set, they replace the loaded ones.
    """

    def __init__(self, load: Load, count: int, ahead: int, workers: int) -> None:
        self._load, self._count, self.ahead = load, count, ahead
        self._pool = ThreadPoolExecutor(max_workers=workers, thread_name_prefix="beags-views")
        self._coming: dict[int, Future[dict[str, Any]]] = {}
        self.labels: list[CompressedMap] = []

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: int | slice) -> Any:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(self._count))]
        if not -self._count <= index < self._count:
            raise IndexError(index)
        index %= self._count
        coming = self._coming.pop(index, None)
        data = dict(self._load(index) if coming is None else coming.result())
        if self.labels:
            data["labels"] = self.labels[index].unpacked()
        return data

    def expect(self, indices: Iterable[int]) -> None:
        """Start to load the first ``ahead`` of the views that will be used next, and drop others."""
        wanted = list(dict.fromkeys(indices))[: self.ahead]
        for index in set(self._coming) - set(wanted):
            self._coming.pop(index).cancel()
        for index in wanted:
            if index not in self._coming:
                self._coming[index] = self._pool.submit(self._load, index)


class Lazy(Sequence[Any]):
    """V items, each made anew when it is used."""

    def __init__(self, make: Callable[[int], Any], count: int) -> None:
        self._make, self._count = make, count

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: int | slice) -> Any:
        chosen = range(self._count)[index]
        return self._make(chosen) if isinstance(chosen, int) else [self._make(i) for i in chosen]
