"""The tab Size in nerfstudio's viewer, without a browser: clicks on known places, and the size of exported files."""

from __future__ import annotations

import json
import re
import shlex

import numpy as np
import pytest
import torch
from random_surfels import a_rotation
from solid_runs import POINTS, write_solids, write_solids_run

pytest.importorskip("nerfstudio")

from clicked_pages import click_on
from viewer_windows import Window, wait_until
from written_splats import read_ply

from beags_plugin.commands.cli import main
from beags_plugin.plugin.viewer.choice import Choice

LOW, HIGH = (torch.tensor(POINTS[name], dtype=torch.float64) for name in ("low", "high"))
TURN, SHIFT, SCALE = a_rotation(3), torch.tensor([0.4, -0.2, 0.1], dtype=torch.float64), 0.5


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    """Return config.yml of a run with objects, whose data parser has turned and scaled the world."""
    root = tmp_path_factory.mktemp("lab")
    config, _ = write_solids_run(root / "run", write_solids(root / "lab"), assigned=True)
    transform = torch.cat([TURN, SHIFT[:, None]], dim=1)
    (root / "run/dataparser_transforms.json").write_text(json.dumps({"transform": transform.tolist(), "scale": SCALE}))
    return config


@pytest.fixture(scope="module")
def window(config):
    window = Window(config)
    yield window
    window.close()


@pytest.fixture
def tab(window):
    """Return the tab as it is when the viewer opens."""
    window.panel.choose(Choice())
    window.panel.size_tab.forget()
    return window.panel.size_tab


def said(tab) -> str:
    """Return what the tab says, as people read it."""
    return re.sub(r"&#(\d+);", lambda code: chr(int(code[1])), tab._status.content)


def in_input(point: torch.Tensor) -> torch.Tensor:
    """Return a point of the run's frame in the input's."""
    return (point / SCALE - SHIFT) @ TURN


def nodes(tab) -> set[str]:
    """Return the names of what the tab shows in the scene."""
    return {mark._impl.name for mark in tab._marks}


def measured(tab, length: str = "12 cm") -> str:
    """Click on both blocks, and type a length; return the text for the command line."""
    tab.clicks.value = True
    tab.clicked(click_on(POINTS["low"]))
    tab.clicked(click_on(POINTS["high"]))
    tab.typed(length)
    return said(tab).split("`")[1]


def test_two_clicks_and_a_length_give_what_the_command_line_is_told(tab):
    assert "Tick Click two points" in said(tab) and tab.scale_by() == ""
    text = measured(tab)
    option, given = shlex.split(text)
    first, second, number, unit = given.split()
    assert (option, number, unit) == ("--scale-by", "12", "cm")
    for place, point in ((first, LOW), (second, HIGH)):
        found = torch.tensor([float(x) for x in place.split(",")], dtype=torch.float64)
        assert (found - in_input(point)).norm() < 0.02 / SCALE  # a disc's thickness, and the mouse's pixel
    apart = float((in_input(LOW) - in_input(HIGH)).norm())
    metres = float(re.search(r"A unit of the input is ([\d.]+) m", said(tab))[1])
    assert metres == pytest.approx(0.12 / apart, rel=0.05)
    assert not tab.clicks.value, "two points are enough"


def test_points_and_line_are_shown_where_they_were_clicked(tab):
    tab.clicked(click_on(POINTS["low"]))
    assert nodes(tab) == {"/beags_size/A", "/beags_size/name_A"}
    tab.clicked(click_on(POINTS["high"]))
    assert nodes(tab) == {f"/beags_size/{name}" for name in ("A", "name_A", "B", "name_B", "line")}
    handle = tab.server.scene._handle_from_node_name["/beags_size/B"]
    assert np.linalg.norm(handle.position / 10 - HIGH.numpy()) < 0.02
    tab.clicked(click_on(POINTS["floor"]))  # begins anew
    assert nodes(tab) == {"/beags_size/A", "/beags_size/name_A"} and "B is missing" in said(tab)
    tab.forget()
    assert nodes(tab) == set() and "Tick Click two points" in said(tab)


def test_mistakes_are_told_in_a_sentence_and_change_nothing(tab):
    tab.typed("12 apples")
    assert said(tab) == "'12 apples' is no length: give one such as 12 cm, in mm, cm, m, in or ft."
    tab.typed("0 cm")
    assert "'0 cm' is no length" in said(tab)
    tab.typed("12 cm")
    assert said(tab).startswith("Two points are missing for the size: click in the tab Size")
    tab.clicked(click_on((0.0, 0.0, 50.0)))
    assert said(tab) == "Nothing solid is shown there: click on the scene." and tab.measure.places == ()
    tab.clicked(click_on(POINTS["low"]))
    tab.clicked(click_on(POINTS["low"]))
    assert said(tab) == "That is A again: click on the other point, or come nearer."
    assert len(tab.measure.places) == 1 and nodes(tab) == {"/beags_size/A", "/beags_size/name_A"}
    tab.clicked(click_on(POINTS["high"]))
    assert "--scale-by" in said(tab)
    tab.typed("")
    assert said(tab).startswith("The length from A to B is missing: type it")


def exported(panel) -> str:
    """Export what is shown; return what the panel says in the end."""
    panel.notes = {}
    panel.files.start()
    ends = ("Exported", "Not exported")
    wait_until(lambda: panel.notes.get("export", "Exporting").startswith(ends), lambda: panel.notes)
    return panel.notes["export"]


def test_what_is_exported_is_as_large_as_beags_export_makes_it(window, tab, config, tmp_path):
    panel = window.panel
    text = measured(tab, "30 cm")
    panel.object.value = "high"
    panel.act("Isolate")
    path = re.fullmatch(r"Exported to (.*\.ply), to scale\.", exported(panel))[1]
    main(["export", "--load-config", str(config), "--object", "high", "--keep-all", *shlex.split(text),
          "--output", str(tmp_path)])  # fmt: skip
    found, exact = read_ply(path)[0], read_ply(tmp_path / "high.ply")[0]
    assert torch.equal(found.means, exact.means) and torch.equal(found.log_scales, exact.log_scales)
    tab.forget()
    plain = read_ply(re.fullmatch(r"Exported to (.*\.ply)", exported(panel))[1])[0]
    size = float(in_input(LOW).dist(in_input(HIGH)))
    assert float((found.means / plain.means).median()) == pytest.approx(0.3 / size, rel=0.05)
    tab.clicked(click_on(POINTS["low"]))
    assert "Nothing solid" in said(tab), "what is hidden takes no click"


def test_half_a_measure_and_a_print_without_a_size_are_refused(window, tab):
    panel = window.panel
    tab.clicked(click_on(POINTS["low"]))
    assert exported(panel).startswith("Not exported: B is missing for the size: click in the tab Size")
    tab.forget()
    pytest.importorskip("open3d")
    pytest.importorskip("trimesh")
    former, panel.format.value = panel.format.value, "stl"
    try:
        assert "the size of the scene is not known: give a length in the tab Size." in exported(panel)
    finally:
        panel.format.value = former


def test_a_busy_scene_takes_no_click(window, tab, monkeypatch):
    from types import SimpleNamespace

    monkeypatch.setattr(window.model.viewing, "lock", SimpleNamespace(acquire=lambda timeout: False))
    tab.clicked(click_on(POINTS["low"]))
    assert said(tab) == "The scene is busy: click again." and tab.measure.places == ()
