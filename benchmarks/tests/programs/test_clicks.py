"""Simulated clicks find the objects of a small run whole."""

from __future__ import annotations

import sys

import pytest

pytest.importorskip("nerfstudio")

from solid_runs import write_solids, write_solids_run

from beags_benchmarks.studies import clicks


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    folder = tmp_path_factory.mktemp("clicks")
    return write_solids_run(folder / "run", write_solids(folder / "lab"), assigned=True, spilled=False)[0]


def test_simulated_clicks_find_both_blocks(config):
    found = clicks.measure(config, 3)
    assert list(found) == ["low", "high"] and all(len(values) == 3 for values in found.values())
    assert all(values[-1] > 0.95 for values in found.values()), found


def test_the_program_prints_a_line_for_each_object(config, capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["clicks", str(config), "--clicks", "1"])
    clicks.main()
    names = [line.split()[0] for line in capsys.readouterr().out.splitlines()[-3:]]
    assert names == ["low", "high", "mean"]
