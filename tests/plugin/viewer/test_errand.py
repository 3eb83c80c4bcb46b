"""Picking for a program that waits: what the viewer asks for before it saves, and how it tells where its page is."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from solid_runs import POINTS, write_solids, write_solids_run

pytest.importorskip("nerfstudio")

from clicked_pages import click_on
from viewer_windows import Window, told, wait_until

from beags_plugin.picking.picks import Picks
from beags_plugin.plugin.viewer import errand
from beags_plugin.plugin.viewer.errand import Errand

NAMES = ("bear 1", "bear 2")


def picked(picks: Picks, place: int, name: str = "") -> Picks:
    """Return picks in which an object is picked, and named."""
    one = picks.objects[place]
    one = replace(one, members=torch.ones(1, dtype=torch.bool), marks=(SimpleNamespace(),), name=name or one.name)
    return replace(picks, objects=(*picks.objects[:place], one, *picks.objects[place + 1 :]))


def test_missing_objects_and_names_are_doubts():
    errand = Errand(Path("out"), NAMES)
    picks = errand.picks()
    assert [one.name for one in picks.objects] == list(NAMES)
    assert errand.doubt(picks) is None  # saving says that nothing is picked
    first = picked(picks, 0, "cup")
    assert "1 of 2 objects are picked, bear 2 not: press Another object" in (errand.doubt(first) or "")
    assert "bear 2 has no name of its own yet" in (errand.doubt(picked(first, 1)) or "")
    assert "bear 1, bear 2 have no name of their own yet" in (errand.doubt(picked(picked(picks, 0), 1)) or "")
    assert errand.doubt(picked(first, 1, "plate")) is None
    assert Errand(Path("out"), ("bear",)).doubt(picked(Errand(Path("out"), ("bear",)).picks(), 0)) is None
    assert "2 objects" in errand.help() and "Another object" not in Errand(Path("out"), ("bear",)).help()


@pytest.fixture
def window(tmp_path, monkeypatch):
    """Yield the viewer of a run of the solids that two objects are to be picked in."""
    for name in ("BROWSER", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    config, _ = write_solids_run(tmp_path / "run", write_solids(tmp_path / "lab"))
    given = Errand(tmp_path / "picks", NAMES)
    opened = Window(config, change=lambda model: setattr(model.viewing, "errand", given))
    yield opened
    opened.close()


def test_masks_are_saved_once_all_objects_are_picked_and_named_or_it_is_asked_for_twice(window, tmp_path, monkeypatch):
    ended = []
    monkeypatch.setattr(Errand, "end", lambda self, server: ended.append(server))
    tab = window.panel.pick_tab
    assert tab.clicks.value and not tab.keep.visible and tab.folder.disabled
    assert "Click on the first of 2 objects" in tab.note
    tab._save()
    told(tab, "nothing has been picked yet".capitalize())
    tab.clicked(click_on(POINTS["low"]))
    told(tab, "Gaussians")
    tab._save()
    told(tab, "1 of 2 objects are picked")
    tab.work.change(lambda picks: picks.named("low").another())
    tab.clicked(click_on(POINTS["high"]))
    told(tab, "bear 2: ")
    tab._save()
    told(tab, "bear 2 has no name of its own yet")
    assert not ended and not (tmp_path / "picks").exists()
    tab._save()
    assert "the program that opened it goes on" in told(tab, "Saved ")
    wait_until(lambda: ended)  # The sentence is shown before.
    assert ended == [window.viewer.viser_server]
    names = json.loads((tmp_path / "picks/classes.json").read_text())
    assert sorted(names.values()) == ["background", "bear 2", "low"]
    assert list((tmp_path / "picks/masks").glob("*.png"))


def test_pages_open_with_the_tab_and_the_terminal_tells_how_to_come_to_them(window, capsys):
    tabs = next(
        each for each in window.viewer.viser_server.gui._container_handle_from_id.values() if hasattr(each, "_parent")
    )
    assert tabs._parent._labels[0] == "Pick" and len(tabs._parent._labels) == len(tabs._parent._tabs)
    server = window.viewer.viser_server
    Errand(Path("out"), NAMES).serve(server)
    said = " ".join(capsys.readouterr().out.split())
    assert f"Pick in the browser: http://{server.get_host()}:{server.get_port()}" in said
    assert f"No window can be opened here. From another computer, first run there: ssh -L {server.get_port()}:" in said


def test_a_page_is_opened_where_there_are_windows(monkeypatch, capsys):
    opened = []
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(errand.webbrowser, "open", opened.append)
    server = SimpleNamespace(
        get_host=lambda: "127.0.0.1", get_port=lambda: 7007, on_client_disconnect=lambda heard: None
    )
    Errand(Path("out"), ("bear",)).serve(server)  # type: ignore[arg-type]
    wait_until(lambda: opened)
    assert opened == ["http://127.0.0.1:7007"] and "ssh" not in capsys.readouterr().out


def test_a_page_that_was_closed_is_told_unless_another_is_there(monkeypatch, capsys):
    monkeypatch.setattr(errand, "_PATIENCE", 0.0)
    pages = {}
    server = SimpleNamespace(get_host=lambda: "127.0.0.1", get_port=lambda: 7007, get_clients=lambda: pages)
    Errand._left(server)  # type: ignore[arg-type]
    said = " ".join(capsys.readouterr().out.split())
    assert "nothing is saved yet" in said and "open http://127.0.0.1:7007 again, or press Ctrl-C" in said
    pages[0] = "a page"
    Errand._left(server)  # type: ignore[arg-type]
    assert not capsys.readouterr().out
