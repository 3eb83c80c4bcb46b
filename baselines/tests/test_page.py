"""The page: its options are those of the classes, its methods those that are installed, and its command parses."""

from __future__ import annotations

import re
import runpy
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path

import pytest

from beags_plugin.refiners import make_refiner

FOLDER = Path(__file__).resolve().parents[1]
PAGE = FOLDER / "README.md"
WRITER = runpy.run_path(str(FOLDER / "page.py"))


def installed() -> dict[str, str]:
    points = entry_points(group="beags.refiners")
    return {point.name: point.value for point in points if point.value.startswith("beags_baselines.")}


def test_the_options_are_those_of_the_classes():
    text = PAGE.read_text("utf8")
    assert WRITER["page"](text) == text, "run python baselines/page.py"
    assert "| `flashsplat` | `gamma` | 0.4 |" in text


def test_an_option_without_a_description_is_refused():
    with pytest.raises(ValueError, match="Silent.level has no docstring"):
        list(WRITER["described"](Silent))


@dataclass(frozen=True)
class Silent:
    level: int = 1


def test_every_method_has_a_row():
    methods = PAGE.read_text("utf8").partition("## Options")[0]
    assert re.findall(r"^\| `([\w-]+)` \|", methods, re.MULTILINE) == sorted(installed())


def test_the_command_of_the_page_chooses_a_refiner_and_its_options():
    pytest.importorskip("nerfstudio")
    import tyro

    from beags_baselines.trace3d import Trace3DRefiner
    from beags_plugin.plugin.options.config import BeagsTrainerConfig
    from beags_plugin.plugin.presets import load_preset

    command = re.search(r"^    ns-train beags --data X (.*?)\n\n", PAGE.read_text("utf8"), re.M | re.S)
    assert command is not None
    parser, preset = tyro.conf.FlagConversionOff[BeagsTrainerConfig], load_preset("beags").config
    model = tyro.cli(parser, args=command[1].replace("\\\n", " ").split(), default=preset).pipeline.model
    assert make_refiner(model.refiner, model.refiner_options) == Trace3DRefiner(min_pixels=25)
    assert model.prepare.reprojection == "none"
