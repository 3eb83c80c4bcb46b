"""Bars are shown where something lasts, not where it is over before one could read them."""

from __future__ import annotations

import pytest

from beags_plugin.system import progress
from beags_plugin.system.progress import counted, each_view, progress_bar


def clock(monkeypatch, seconds_per_call: float) -> None:
    calls = iter(range(10**6))
    monkeypatch.setattr(progress, "monotonic", lambda: seconds_per_call * next(calls))


def test_a_bar_shows_what_is_done(capsys):
    with progress_bar("Counting sheep") as update:
        update(3, 7)
    assert "Counting sheep" in (printed := capsys.readouterr().out) and "3/7" in printed


def test_a_passing_bar_leaves_nothing_where_output_is_no_terminal(capsys, monkeypatch):
    for seconds in (0.4, 3.0):
        clock(monkeypatch, seconds)
        with progress_bar("Counting sheep", passing=True) as update:
            assert list(counted("abc", 3, update)) == ["a", "b", "c"]
    assert capsys.readouterr().out == ""


def test_counted_items_are_reported_once_they_are_done():
    reported = []
    for item in counted("ab", 2, lambda *steps: reported.append(steps)):
        assert len(reported) == "ab".index(item)
    assert reported == [(1, 2), (2, 2)]


@pytest.mark.parametrize(("seconds", "drawn"), [(0.4, False), (3.0, True)])
def test_a_passing_bar_is_drawn_only_after_a_moment(capsys, monkeypatch, seconds, drawn):
    clock(monkeypatch, seconds)
    started = []
    monkeypatch.setattr(progress.Progress, "start", lambda self: started.append(self.live.transient))
    with progress_bar("Counting sheep", passing=True) as update:
        for done in range(1, 5):
            update(done, 4)
    assert started == [True] * 4 * drawn  # The bar is removed at the end.
    assert "Counting" not in capsys.readouterr().out


def test_errors_come_through_and_leave_no_bar(capsys):
    for passing in (False, True):
        with pytest.raises(ValueError, match="wolf"), progress_bar("Counting sheep", passing) as update:
            update(1, 2)
            raise ValueError("wolf")


def test_views_come_one_after_the_other_as_they_are_asked_for():
    calls, reported = [], []

    def work(index):
        calls.append(index)
        return index * index

    views = each_view(4, work, lambda done, count: reported.append((done, count)))
    assert next(views) == 0 and calls == [0]  # nothing is done before it is asked for
    assert list(views) == [1, 4, 9]
    assert reported == [(1, 4), (2, 4), (3, 4), (4, 4)]
    assert list(each_view(0, work)) == []
