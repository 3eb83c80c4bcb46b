"""Two-stage retrieval of objects from a video of views (method, section 2; COB-GS), for any video predictor."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from beags_plugin.masks.sources.prompts import Prompt, PromptedObject
from beags_plugin.system.errors import UserError

Box = tuple[float, float, float, float]


class VideoPredictor(Protocol):
    """Tracker of one object from prompted frames to others, such as SAM2."""

    def track(self, prompts: Mapping[int, Prompt], frames: Sequence[int]) -> Iterator[tuple[int, np.ndarray]]:
        """Yield each frame and its logits [H, W] float32 (above 0: the object), independently of earlier calls.

        frames: consecutive, up or down; the first is prompted.
        """
        ...


class Detector(Protocol):
    """Detector of a text in a frame, such as Grounding DINO."""

    def detect(self, frame: int, text: str, threshold: float) -> list[tuple[Box, float]]:
        """Return boxes (left, top, right, bottom) in pixels and their scores of ``threshold`` or more."""
        ...


@dataclass(frozen=True)
class Retrieval:
    """Options of the retrieval.

    threshold: least score of a detection in stage 1; strict: the same in stage 2, where a wrong one would add an absent
    object. searched: most frames of a run in which the text is searched. retries: repetitions of stage 2 for runs that
    stay empty. least: share of the image below which an object counts as empty.
    """

    threshold: float = 0.3
    strict: float = 0.5
    searched: int = 8
    retries: int = 2
    least: float = 1e-4


class BestLabels:
    """The object of the largest logit so far per frame, on disk: memory does not grow with frames or objects."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def add(self, frame: int, class_id: int, logits: np.ndarray) -> None:
        """Give the object the pixels where its logit, [H, W] float32, is above 0 and those of earlier objects."""
        path = self.folder / f"{frame:06d}.npz"
        values = np.clip(logits, -6e4, 6e4).astype(np.float16)
        labels, best = np.zeros(values.shape, np.uint16), np.zeros(values.shape, np.float16)
        if path.exists():
            with np.load(path) as held:
                labels, best = held["labels"], held["best"]
        larger = values > best
        labels[larger], best[larger] = class_id, values[larger]
        np.savez_compressed(path, labels=labels, best=best)

    def labels(self, frame: int, shape: tuple[int, int]) -> np.ndarray:
        """Return the labels of a frame, [H, W] uint16; 0 before any ``add``."""
        path = self.folder / f"{frame:06d}.npz"
        if not path.exists():
            return np.zeros(shape, np.uint16)
        with np.load(path) as held:
            return held["labels"]


def retrieve(
    objects: Sequence[PromptedObject],
    frame_of: Mapping[str, int],
    names: Sequence[str],
    predictor: VideoPredictor,
    detector: Detector | None,
    best: BestLabels,
    options: Retrieval,
    progress: Callable[[int, int], None],
) -> list[str]:
    """Track every object through all frames, then again through the runs of frames where it was lost.

    frame_of: view of a prompt to its frame. names: of all frames. detector: needed for an object with only a text.
    Stage 1 starts at the first prompted frame (or the best detection) and goes both ways. In stage 2 the detector
    searches, more strictly, each run where the object is empty; from a detection, tracking goes both ways in the run.
    Returns sentences about runs that stayed empty. Raises ``UserError`` if an object is found in no frame.
    """
    notes: list[str] = []
    for index, one in enumerate(objects):
        tracked = _Tracking(one, len(names), predictor, detector, best, options)
        prompts = {frame_of[view]: prompt for view, prompt in one.prompts.items()}
        if not prompts:
            found = tracked.detected(range(len(names)), options.threshold)
            if found is None:
                raise UserError(
                    f"{one.text!r} ({one.name}) is found in no view with a score of {options.threshold} or more: give "
                    "it a box, another text, or a lower threshold."
                )
            prompts = dict([found])
        tracked.both_ways(prompts, 0, len(names) - 1)
        tracked.second_stage()
        lost = [f"{names[run[0]]} to {names[run[-1]]}" for run in runs_of(~tracked.seen)]
        if lost:
            notes.append(
                f"{one.name} is empty from {'; '.join(lost[:5])}{' and in other runs' if len(lost) > 5 else ''}: if it "
                "shows there, add a prompt in one of these views."
            )
        progress(index + 1, len(objects))
    return notes


class _Tracking:
    """Tracking of one object, and the frames where it was found."""

    def __init__(self, one, frames: int, predictor, detector, best: BestLabels, options: Retrieval) -> None:
        self.one, self.predictor, self.detector, self.best, self.options = one, predictor, detector, best, options
        self.seen = np.zeros(frames, bool)

    def both_ways(self, prompts: Mapping[int, Prompt], first: int, last: int) -> None:
        """Track from the first prompted frame up to ``last`` and down to ``first``."""
        start = min(prompts)
        for frames in [range(start, last + 1), range(start, first - 1, -1)]:
            down = frames.step < 0
            if down and len(frames) == 1:
                continue
            for frame, logits in self.predictor.track(prompts, frames):
                if down and frame == start:
                    continue  # already tracked upwards
                if (logits > 0).sum() >= max(1.0, self.options.least * logits.size):
                    self.seen[frame] = True
                    self.best.add(frame, self.one.class_id, logits)

    def second_stage(self) -> None:
        """Prompt again in the runs where the object was lost, and track it in the run alone."""
        if self.one.text is None or self.detector is None:
            return
        for _ in range(self.options.retries):
            found_any = False
            for run in runs_of(~self.seen):
                found = self.detected(run, self.options.strict)
                if found is not None:
                    found_any = True
                    self.both_ways(dict([found]), run[0], run[-1])
            if not found_any:
                return

    def detected(self, frames: Sequence[int], threshold: float) -> tuple[int, Prompt] | None:
        """Return the best detection in some evenly spread ``frames``: its frame, and its box as a prompt."""
        if self.one.text is None or self.detector is None:
            return None
        count = min(self.options.searched, len(frames))
        chosen = [frames[(2 * place + 1) * len(frames) // (2 * count)] for place in range(count)]
        best: tuple[float, int, Box] | None = None
        for frame in chosen:
            for box, score in self.detector.detect(frame, self.one.text, threshold):
                if score >= threshold and (best is None or score > best[0]):
                    best = (score, frame, box)
        return None if best is None else (best[1], Prompt(box=best[2]))


def runs_of(mask: np.ndarray) -> list[range]:
    """Return the maximal runs of True in [N] bool."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return [range(int(start), int(end)) for start, end in zip(edges[::2], edges[1::2], strict=True)]
