"""The command line that a measurement names."""

import sys
from importlib.machinery import ModuleSpec
from types import ModuleType

import pytest

from beags_benchmarks.provenance import command


@pytest.mark.parametrize(
    ("module", "program"),
    [
        (None, "beags"),
        ("beags_plugin.commands.cli", "beags"),
        ("beags_benchmarks.studies.page_tables", "python -m beags_benchmarks.studies.page_tables"),
        ("beags_benchmarks.__main__", "python -m beags_benchmarks"),
    ],
)
def test_a_measurement_names_the_command_that_was_typed(module, program, monkeypatch):
    main = ModuleType("__main__")
    main.__spec__ = None if module is None else ModuleSpec(module, None)
    monkeypatch.setitem(sys.modules, "__main__", main)
    monkeypatch.setattr(sys, "argv", ["anything", "bases.toml", "--variants", "faster rates"])

    assert command() == f"{program} bases.toml --variants 'faster rates'"
