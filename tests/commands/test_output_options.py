"""Options of the commands: results go to --output or --output-dir, in each; help has no box of an unnamed kind."""

from __future__ import annotations

import contextlib
import io
import typing

import pytest
import tyro

from beags_plugin.commands import cli, masks

BENCH = ("ablation", "file", "paper", "captures", "sample", "nvos") if "bench" in cli.COMMANDS.names() else ()
WORDS = [
    *([command.__name__.lower()] for command in typing.get_args(cli.Command) if command.__name__ != "Masks"),
    *(["masks", action.__name__.lower()] for action in (masks.Agree, masks.Check, masks.Make, masks.Reproject)),
    *(["bench", name] for name in BENCH),
]


def help_of(words: list[str]) -> str:
    out = io.StringIO()
    with contextlib.redirect_stdout(out), pytest.raises(SystemExit):
        cli.main([*words, "--help"])
    return out.getvalue()


@pytest.mark.parametrize("words", WORDS, ids=" ".join)
def test_both_names_of_the_output_are_taken_where_one_is(words):
    text = help_of(words)
    assert ("--output " in text) == ("--output-dir " in text), text
    assert "options options" not in text


def test_ns_train_takes_both_names():
    pytest.importorskip("nerfstudio")
    from beags_plugin.plugin.options.config import BeagsTrainerConfig
    from beags_plugin.plugin.presets import load_preset

    kind = tyro.conf.FlagConversionOff[BeagsTrainerConfig]
    for flag in ("--output", "--output-dir"):
        found = tyro.cli(kind, args=[flag, "there"], default=load_preset("beags").config)
        assert str(found.output_dir) == "there"
