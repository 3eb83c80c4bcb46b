"""Two-stage retrieval with a scripted predictor and detector: the prompted frames, and the masks."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest

from beags_plugin.masks.sources.prompts import Prompt, PromptedObject
from beags_plugin.masks.sources.two_stage import BestLabels, Retrieval, retrieve, runs_of
from beags_plugin.system.errors import UserError

SHAPE = (6, 8)
BOX = (1.0, 1.0, 4.0, 4.0)
ALWAYS = Retrieval(threshold=0.3, strict=0.5, searched=8, retries=2, least=0.01)


class Scripted:
    """Tracks an object from a prompt until the first frame (in the direction of travel) where it is ``broken``.

    A box's left edge says which object is meant: its row in the map, its value as logit.
    """

    def __init__(self, broken: Mapping[float, set[int]] | None = None, value: Mapping[float, float] | None = None):
        self.broken, self.value = broken or {}, value or {}
        self.calls: list[tuple[tuple[int, ...], tuple[int, ...]]] = []

    def track(self, prompts: Mapping[int, Prompt], frames: Sequence[int]) -> Iterator[tuple[int, np.ndarray]]:
        self.calls.append((tuple(sorted(prompts)), tuple(frames)))
        box = next(iter(prompts.values())).box
        assert box is not None
        alive = True
        for frame in frames:
            alive = frame in prompts or (alive and frame not in self.broken.get(box[0], set()))
            logits = np.full(SHAPE, -1024.0, np.float32)
            if alive:
                logits[int(box[0]) : int(box[0]) + 3] = self.value.get(box[0], 5.0)
            yield frame, logits


class Finding:
    """A detector with a score for some frames."""

    def __init__(self, scores: Mapping[int, float], left: float = 1.0) -> None:
        self.scores, self.left, self.asked = scores, left, []

    def detect(self, frame: int, text: str, threshold: float) -> list[tuple[tuple[float, float, float, float], float]]:
        self.asked.append((frame, threshold))
        score = self.scores.get(frame, 0.0)
        return [((self.left, 1.0, 4.0, 4.0), score)] if score >= threshold else []


def run(tmp_path: Path, objects, predictor, detector=None, frames: int = 10, options=ALWAYS):
    best = BestLabels(tmp_path)
    stems = [f"v{index}" for index in range(frames)]
    frame_of = {stem: index for index, stem in enumerate(stems)}
    notes = retrieve(objects, frame_of, stems, predictor, detector, best, options, lambda done, total: None)
    return notes, [best.labels(frame, SHAPE) for frame in range(frames)]


def test_the_first_stage_goes_both_ways_from_the_prompt(tmp_path):
    predictor = Scripted()
    notes, maps = run(tmp_path, [PromptedObject(1, "cup", {"v3": Prompt(BOX)})], predictor)
    assert predictor.calls == [((3,), (3, 4, 5, 6, 7, 8, 9)), ((3,), (3, 2, 1, 0))]
    assert notes == [] and all((m == 1).any() for m in maps)


def test_a_lost_run_is_prompted_again_more_strictly_and_tracked_in_itself_alone(tmp_path):
    # tracking up breaks at 5 and never comes back; the detector sees the object in 7 with enough, in 5 with too little
    predictor, detector = Scripted({1.0: {5}}), Finding({5: 0.4, 7: 0.8, 8: 0.6})
    one = PromptedObject(1, "cup", {"v2": Prompt(BOX)}, text="a cup")
    notes, maps = run(tmp_path, [one], predictor, detector)
    assert predictor.calls[2:] == [((7,), (7, 8, 9)), ((7,), (7, 6, 5))]
    assert {threshold for _, threshold in detector.asked} == {0.5} and {f for f, _ in detector.asked} == {5, 6, 7, 8, 9}
    # broken at 5 from above too: it stays empty and is reported, after a second search that finds nothing
    assert [bool(m.any()) for m in maps] == [True] * 5 + [False] + [True] * 4
    assert len(notes) == 1 and "cup is empty from v5 to v5" in notes[0]
    assert [frame for frame, _ in detector.asked].count(5) == 2


def test_each_of_two_lost_runs_is_searched_and_the_retries_end(tmp_path):
    predictor = Scripted({1.0: {3, 8}})
    detector = Finding({1: 0.9, 9: 0.9})
    one = PromptedObject(4, "cup", {"v5": Prompt(BOX)}, text="a cup")
    _, maps = run(tmp_path, [one], predictor, detector)
    assert predictor.calls[2:] == [((1,), (1, 2, 3)), ((1,), (1, 0)), ((9,), (9,)), ((9,), (9, 8))]
    assert [bool(m.any()) for m in maps] == [True, True, True, False, True, True, True, True, False, True]


def test_without_a_text_the_lost_run_is_reported(tmp_path):
    notes, _ = run(tmp_path, [PromptedObject(1, "cup", {"v0": Prompt(BOX)})], Scripted({1.0: {6}}))
    assert "cup is empty from v6 to v9" in notes[0] and "add a prompt" in notes[0]


def test_a_text_alone_starts_at_the_best_detection(tmp_path):
    predictor, detector = Scripted(), Finding({1: 0.35, 6: 0.9})
    _, maps = run(tmp_path, [PromptedObject(1, "cup", {}, text="a cup")], predictor, detector)
    assert predictor.calls[0] == ((6,), (6, 7, 8, 9)) and all(m.any() for m in maps)
    with pytest.raises(UserError, match="'a spoon' .* is found in no view"):
        run(tmp_path, [PromptedObject(1, "spoon", {}, text="a spoon")], predictor, Finding({}))


def test_the_larger_logit_wins_where_objects_overlap(tmp_path):
    predictor = Scripted(value={1.0: 2.0, 2.0: 6.0})
    objects = [
        PromptedObject(3, "under", {"v0": Prompt(BOX)}),
        PromptedObject(9, "over", {"v1": Prompt((2.0, 1.0, 4.0, 4.0))}),
    ]
    for order in (objects, objects[::-1]):
        folder = tmp_path / order[0].name
        folder.mkdir()
        _, maps = run(folder, order, predictor, frames=3)
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
