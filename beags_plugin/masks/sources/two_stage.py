"""Two-stage retrieval of objects from a video of views (COB-GS; method, section 2), for any video predictor."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np

from beags_plugin.masks.sources.prompts import Prompt, PromptedObject
from beags_plugin.system.errors import UserError

Box = tuple[float, float, float, float]

NEAR = 0.7  # least score of a box in stage 1, as a share of the best one (COB-GS)
SURE = 0.85  # least score of a box in stage 2, as a share of the best one of stage 1 (COB-GS)
SEARCHED = 8  # views, evenly spread, in which a text is searched for before the others
EMPTY = 1e-4  # share of the image below which an object counts as lost


class Memory(Protocol):
    """What a tracker such as SAM2 knows of one object: prompted frames, and frames tracked from them."""

    def prompt(self, frame: int, places: Sequence[Prompt]) -> None:
        """Remember the places of the object's parts in a frame; all earlier prompts stay."""
        ...

    def track(self, frames: range) -> Iterator[tuple[int, np.ndarray]]:
        """Yield consecutive frames, up or down, and the object's logits [H, W] float32 (above 0: the object)."""
        ...


class Detector(Protocol):
    """Detector of a text in a frame, such as Grounding DINO."""

    def detect(self, frame: int, text: str, threshold: float) -> list[tuple[Box, float]]:
        """Return boxes (left, top, right, bottom) in pixels and their scores of ``threshold`` or more."""
        ...


class BestLabels:
    """The labels of each frame by the largest logit so far, on disk, so that memory does not grow with frames."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def add(self, frame: int, class_id: int, logits: np.ndarray) -> None:
        """Give the object the pixels where its logit, [H, W] float32, is above 0 and those of earlier objects."""
        path = self.folder / f"{frame:06d}.npz"
        values = np.clip(logits, -6e4, 6e4).astype(np.float16)
        labels, best = np.zeros(values.shape, np.uint16), np.zeros(values.shape, np.float16)
        if path.exists():
            with np.load(path) as saved:
                labels, best = saved["labels"], saved["best"]
        larger = values > best
        labels[larger], best[larger] = class_id, values[larger]
        np.savez_compressed(path, labels=labels, best=best)

    def labels(self, frame: int, shape: tuple[int, int]) -> np.ndarray:
        """Return the labels of a frame, [H, W] uint16; 0 before any ``add``."""
        path = self.folder / f"{frame:06d}.npz"
        if not path.exists():
            return np.zeros(shape, np.uint16)
        with np.load(path) as saved:
            return saved["labels"]


def retrieve(
    objects: Sequence[PromptedObject],
    frame_of: Mapping[str, int],
    names: Sequence[str],
    new_memory: Callable[[], Memory],
    detector: Detector | None,
    best: BestLabels,
    threshold: float,
    strict: float,
    progress: Callable[[int, int], None],
) -> list[str]:
    """Track every object through all frames, then again where it was lost, with the same memory.

    Stage 1 tracks in both directions from the first prompted frame, or from the best detection. In stage 2 the detector
    searches each frame where the object is still empty; a detection joins the memory, and is tracked in both directions
    through the empty run around it.

    frame_of: view of a prompt to its frame. names: of all frames. detector: needed for objects with a text. threshold,
    strict: least score of a detection in stage 1 and stage 2. Returns sentences about runs that stayed empty. Raises
    ``UserError`` if no frame shows an object.
    """
    notes: list[str] = []
    for index, one in enumerate(objects):
        tracked = _Tracked(one, len(names), new_memory(), detector if one.text else None, best, threshold, strict)
        prompts = {frame_of[view]: [prompt] for view, prompt in one.prompts.items()}
        for done, _ in enumerate(tracked.first_stage(prompts), index * len(names) + 1):
            progress(done, len(objects) * len(names))
        tracked.second_stage()
        if lost := [f"{names[run[0]]} to {names[run[-1]]}" for run in runs_of(~tracked.seen)]:
            notes.append(
                f"{one.name} was not found from {'; '.join(lost[:5])}{' and in other runs' if len(lost) > 5 else ''}: "
                "if it is visible there, add a prompt in one of these views."
            )
    return notes


class _Tracked:
    """An object, its memory, and the frames that show it."""

    def __init__(self, one: PromptedObject, frames: int, memory: Memory, detector, best, threshold, strict) -> None:
        self.one, self.memory, self.detector, self.best = one, memory, detector, best
        self.threshold, self.strict = threshold, strict
        self.seen = np.zeros(frames, bool)
        self.detections: dict[int, list[tuple[Box, float]]] = {}  # detections by frame; the detector runs once on each
        self.score = 0.0  # score of the detection at which tracking started

    def first_stage(self, prompts: Mapping[int, Sequence[Prompt]]) -> Iterator[int]:
        """Track from the first prompted frame, or the best detection, in both directions; yield each frame."""
        prompts = prompts or self._searched()
        for frame, places in prompts.items():
            self.memory.prompt(frame, places)
        yield from self._both_ways(min(prompts), range(len(self.seen)))

    def second_stage(self) -> None:
        """Run the detector on every frame that is still empty, and track its detections through the empty run."""
        least = max(self.strict, SURE * self.score)
        for frame in np.flatnonzero(~self.seen).tolist():
            if not self.seen[frame] and (places := self._detected(frame, least)):
                self.memory.prompt(frame, places)
                list(self._both_ways(frame, next(run for run in runs_of(~self.seen) if frame in run)))

    def _both_ways(self, start: int, run: range) -> Iterator[int]:
        """Track forwards, then backwards, from a frame through a run; yield each frame."""
        for frames in (range(start, run.stop), range(start - 1, run.start - 1, -1)):
            for frame, logits in self.memory.track(frames):
                if (logits > 0).sum() >= max(1.0, EMPTY * logits.size):
                    self.seen[frame] = True
                    self.best.add(frame, self.one.class_id, logits)
                yield frame

    def _searched(self) -> dict[int, list[Prompt]]:
        """Return the best detection in some spread frames, else the first one in the others, by frame."""
        frames = len(self.seen)
        spread = sorted({(2 * place + 1) * frames // (2 * SEARCHED) for place in range(SEARCHED)})
        at = -1
        for place, frame in enumerate([*spread, *(frame for frame in range(frames) if frame not in spread)]):
            if place >= len(spread) and at >= 0:
                break
            self._detected(frame, self.threshold)
            if (score := max((score for _, score in self.detections[frame]), default=0.0)) > self.score:
                at, self.score = frame, score
        if at < 0:
            raise UserError(
                f"{self.one.text!r} ({self.one.name}) is found in no view with a score of {self.threshold} or "
                "more: give it a box, another text, or a lower threshold."
            )
        return {at: self._detected(at, NEAR * self.score)}

    def _detected(self, frame: int, least: float) -> list[Prompt]:
        """Return the boxes in a frame that score ``least`` or more, the best first."""
        if self.detector is None:
            return []
        if frame not in self.detections:
            boxes = self.detector.detect(frame, self.one.text, self.threshold)
            self.detections[frame] = sorted(boxes, key=lambda pair: -pair[1])
        return [Prompt(box=box) for box, score in self.detections[frame] if score >= least]


def runs_of(mask: np.ndarray) -> list[range]:
    """Return the maximal runs of True in [N] bool."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return [range(int(start), int(end)) for start, end in zip(edges[::2], edges[1::2], strict=True)]
