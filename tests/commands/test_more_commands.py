"""Commands of other packages: imported when they are asked for, refused where they cannot be."""

from __future__ import annotations

import sys
from importlib.metadata import EntryPoint

import pytest

from beags_plugin.commands import cli
from beags_plugin.system import registry

MODULE = '''
from dataclasses import dataclass

@dataclass
class Shout:
    """Say it aloud."""

    word: str = "cup"

    def run(self):
        print(self.word.upper())
'''


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """A function that makes the named commands the only ones of other packages, each of a module of its own."""
    monkeypatch.syspath_prepend(tmp_path)

    def install(*names: str) -> None:
        for name in names:
            (tmp_path / f"package_of_{name}.py").write_text(MODULE)
        points = [EntryPoint(name, f"package_of_{name}:Shout", "beags.commands") for name in names]
        monkeypatch.setattr(registry, "entry_points", lambda group: points)
        monkeypatch.setattr(cli, "COMMANDS", registry.Registry("command", "beags.commands", {}))

    yield install
    for name in [name for name in sys.modules if name.startswith("package_of_")]:
        del sys.modules[name]


def test_a_command_of_another_package_runs_and_is_listed(installed, capsys):
    installed("shout", "whisper")
    cli.main(["shout", "--word", "box"])
    assert capsys.readouterr().out == "BOX\n" and "package_of_whisper" not in sys.modules
    with pytest.raises(SystemExit):
        cli.main(["--help"])
    text = " ".join(capsys.readouterr().out.split())
    assert "whisper Say it aloud." in text and "export Write objects" in text


def test_our_commands_look_for_no_others(monkeypatch):
    monkeypatch.setattr(cli.COMMANDS, "names", None)  # is not called
    assert cli.all_commands(["export", "--help"]) is cli.Command


@pytest.mark.parametrize(
    ("names", "words", "sentence"),
    [
        ((), ["bench", "compare", "--plan"], "call pip install ./benchmarks, or make setup."),
        (("export",), ["shout"], "adds a command 'export', which beags has already: uninstall that package."),
    ],
)
def test_what_cannot_be_is_one_sentence(installed, capsys, names, words, sentence):
    installed(*names)
    with pytest.raises(SystemExit) as end:
        cli.main(words)
    assert end.value.code == 2 and sentence in " ".join(capsys.readouterr().out.split())
