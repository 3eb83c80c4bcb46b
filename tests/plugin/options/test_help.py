"""The help of ``ns-train beags``: every option of ours has a text, and those that people set first stand first."""

from __future__ import annotations

import contextlib
import io
import re

import pytest
import tyro
from places import ROOT

pytest.importorskip("nerfstudio")

from beags_plugin.plugin.options.config import BeagsTrainerConfig
from beags_plugin.plugin.presets import FIRST_OPTIONS, load_preset
from beags_plugin.plugin.views.dataparser import BeagsDataParserConfig


@pytest.fixture(scope="module")
def help_text() -> str:
    """The help of ``ns-train beags`` and of beags-data, without the frames of their boxes."""
    out = io.StringIO()
    for kind, default in ((BeagsTrainerConfig, load_preset("beags").config), (BeagsDataParserConfig, None)):
        with pytest.raises(SystemExit), contextlib.redirect_stdout(out):
            tyro.cli(tyro.conf.FlagConversionOff[kind], args=["--help"], default=default or kind())
    return " ".join(re.sub("[─│╭╮╰╯]", " ", out.getvalue()).split())


def test_every_option_of_ours_has_a_text(help_text, monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "scripts"))
    from counts import options

    for option in options():
        *_, name = option.replace("beags-data ", "").split(".")
        flag = option.replace("beags-data ", "")
        start = help_text.index(f" --{flag} ")
        text = help_text[start : help_text.index("(default:", start)]
        if ".options." in flag:  # one text above all options of losses
            assert f"{name}, " in help_text[help_text.index("Options of the loss itself.") :], option
        else:
            assert len(text.split()) > 5, text  # the flag, its kind, and a sentence


def test_options_of_fields_of_rays_are_hidden(help_text):
    assert not re.search(r"\.(enable-)?collider|\.loss-coefficients|\.eval-num-rays|prompt", help_text)


def test_the_first_options_exist_and_are_those_of_the_documents(help_text):
    documented = (ROOT / "docs/training.md").read_text("utf8").partition("## Going on")[0]
    flags = [option.removeprefix("beags-data ").split()[0] for option in FIRST_OPTIONS]
    assert 10 <= len(flags) <= 12 and all(f" {flag} " in help_text for flag in flags)
    assert re.findall(r"^\| `(?:beags-data )?(--\S+) ", documented, re.MULTILINE) == flags
