"""Two-stage retrieval with a scripted memory and detector: what is prompted and tracked, in which order, the masks."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest

from beags_plugin.masks.sources.prompts import Prompt, PromptedObject
from beags_plugin.masks.sources.two_stage import BestLabels, retrieve, runs_of
from beags_plugin.system.errors import UserError

SHAPE = (6, 8)
BOX = (1.0, 1.0, 4.0, 4.0)


class Looks:
    """Knows an object again in frames that look like a prompted one; what it was asked is listed.

    The left edge of the first box is the object's row in the map, and says its logit in ``value``.
    """

    def __init__(self, looks: str, value: Mapping[float, float]) -> None:
        self.looks, self.value, self.asked, self.known = looks, value, [], set()
        self.left = 0.0

    def prompt(self, frame: int, places: Sequence[Prompt]) -> None:
        boxes = [place.box for place in places]
        self.asked.append((frame, len(boxes)))
        self.known.add(self.looks[frame])
        assert boxes[0] is not None
        self.left = self.left or boxes[0][0]

    def track(self, frames: range) -> Iterator[tuple[int, np.ndarray]]:
        self.asked.append(list(frames))
        for frame in frames:
            logits = np.full(SHAPE, -1024.0, np.float32)
            if self.looks[frame] in self.known:
                logits[int(self.left) : int(self.left) + 3] = self.value.get(self.left, 5.0)
            yield frame, logits


class Finding:
    """A detector with scores of boxes for some frames."""

    def __init__(self, scores: Mapping[int, Sequence[float]]) -> None:
        self.scores, self.asked = scores, []

    def detect(self, frame: int, text: str, threshold: float) -> list[tuple[tuple[float, float, float, float], float]]:
        self.asked.append(frame)
        return [(BOX, score) for score in self.scores.get(frame, ()) if score >= threshold]


def run(tmp_path: Path, objects, looks: str, scores=None, value=None):
    """Return the notes, the maps, the memories, one of each object, and put the detector's questions in its place."""
    best, memories = BestLabels(tmp_path), []
    names = [f"v{index}" for index in range(len(looks))]
    frame_of = {name: index for index, name in enumerate(names)}

    def new_memory() -> Looks:
        memories.append(Looks(looks, value or {}))
        return memories[-1]

    detector = None if scores is None else Finding(scores)
    steps = []
    notes = retrieve(objects, frame_of, names, new_memory, detector, best, 0.3, 0.6, lambda *step: steps.append(step))
    total = len(objects) * len(looks)
    assert steps == [(done, total) for done in range(1, total + 1)]  # each view of each object
    assert len(memories) == len(objects)  # stage 2 goes on in the memory of stage 1
    asked = [] if detector is None else detector.asked
    assert len(set(asked)) == len(asked)  # no frame is asked twice
    return notes, [best.labels(frame, SHAPE) for frame in range(len(looks))], [*memories, asked]


def shown(maps) -> str:
    return "".join("x" if labels.any() else "." for labels in maps)


def test_the_first_stage_goes_both_ways_from_the_prompts_and_reports_what_is_lost(tmp_path):
    cup = PromptedObject(1, "cup", {"v3": Prompt(BOX), "v5": Prompt(BOX)})
    notes, maps, (memory, _) = run(tmp_path, [cup], "AAAABCAA")
    assert memory.asked == [(3, 1), (5, 1), [3, 4, 5, 6, 7], [2, 1, 0]] and shown(maps) == "xxxx.xxx"
    assert len(notes) == 1 and "cup was not found from v4 to v4" in notes[0] and "add a prompt" in notes[0]


def test_every_lost_frame_is_asked_and_what_is_found_joins_the_memory(tmp_path):
    # the detector sees the object in 5 and 9 well enough, in 4 not; 3 and 6 look like 5, 8 like none
    cup = PromptedObject(1, "cup", {"v1": Prompt(BOX)}, text="a cup")
    notes, maps, (memory, asked) = run(tmp_path, [cup], "AAABDBBACE", {0: [0.9], 4: [0.59], 5: [0.6], 9: [0.8, 0.7]})
    assert memory.asked[:3] == [(1, 1), list(range(1, 10)), [0]]  # a prompt needs no detection
    assert memory.asked[3:] == [(5, 1), [5, 6], [4, 3], (9, 2), [9], [8]]  # the empty run alone is tracked again
    assert asked == [3, 4, 5, 8, 9]  # 6 came back with 5
    assert shown(maps) == "xxxx.xxx.x" and "v4 to v4; v8 to v8" in notes[0]


def test_a_text_starts_at_all_boxes_near_the_best_and_raises_the_second_threshold(tmp_path):
    # Scores from 0.63 (70 %) on are near 0.9, and stage 2 takes those from 0.765 (85 %) on.
    scores = {1: [0.35], 2: [0.7], 3: [0.62, 0.9, 0.64], 6: [0.76], 7: [0.77]}
    cup = PromptedObject(1, "cup", {}, text="a cup")
    _, maps, (memory, asked) = run(tmp_path, [cup], "AAAAAABC", scores)
    assert memory.asked == [(3, 2), [3, 4, 5, 6, 7], [2, 1, 0], (7, 1), [7], [6]]
    assert shown(maps) == "xxxxxx.x" and asked == list(range(8))


def test_a_text_is_searched_in_spread_frames_then_in_the_others_until_it_is_found(tmp_path):
    cup = PromptedObject(1, "cup", {}, text="a cup")
    spread = [1, 3, 6, 8, 11, 13, 16, 18]
    _, _, (memory, asked) = run(tmp_path, [cup], "A" * 20, {2: [0.3], 4: [0.9]})
    assert memory.asked[0] == (2, 1) and asked == [*spread, 0, 2]
    _, _, (memory, asked) = run(tmp_path, [cup], "A" * 20, {2: [0.9], 11: [0.3], 16: [0.4]})
    assert memory.asked[0] == (16, 1) and asked == spread
    with pytest.raises(UserError, match="'a cup' .* is found in no view with a score of 0.3"):
        run(tmp_path, [cup], "A" * 20, {2: [0.29]})


def test_the_larger_logit_wins_where_objects_overlap(tmp_path):
    objects = [
        PromptedObject(3, "under", {"v0": Prompt(BOX)}),
        PromptedObject(9, "over", {"v1": Prompt((2.0, 1.0, 4.0, 4.0))}),
    ]
    for order in (objects, objects[::-1]):
        folder = tmp_path / order[0].name
        folder.mkdir()
        _, maps, _ = run(folder, order, looks="AAA", value={1.0: 2.0, 2.0: 6.0})
        for class_map in maps:
            assert (class_map[1] == 3).all() and (class_map[2:5] == 9).all() and (class_map[5] == 0).all()


def test_logits_lie_on_disk_one_frame_at_a_time(tmp_path):
    best = BestLabels(tmp_path)
    best.add(4, 1, np.full(SHAPE, 1e6, np.float32))
    best.add(4, 2, np.full(SHAPE, -1.0, np.float32))
    assert [path.name for path in tmp_path.iterdir()] == ["000004.npz"]
    assert (best.labels(4, SHAPE) == 1).all() and not best.labels(5, SHAPE).any()
    assert all(not isinstance(value, np.ndarray) for value in vars(best).values())


def test_runs():
    assert runs_of(np.array([True, False, True, True])) == [range(0, 1), range(2, 4)]
    assert runs_of(np.zeros(3, bool)) == []
