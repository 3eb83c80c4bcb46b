"""The commands in README.md and docs/: every line of a code block that calls a program of ours or of nerfstudio.

Names of the reader's own things (``my_scene``, ``outputs/.../config.yml``) are replaced by tiny ones: ``SUBSTITUTES``.
Commands of ``beags`` that end in seconds then run as they stand, with small sizes appended: ``RUN``. All others
(training, experiments, the viewer, other programs' commands) are parsed by the same parser that would run them, so that
a wrong flag or value fails, but not run (test_readme_commands.py and test_documented_roads.py run trainings). ``make``
targets, and scripts and files that ``python`` and ``pip`` name, must exist. New files in docs/ are found by themselves.
"""

from __future__ import annotations

import re
import shlex
import typing
from importlib import import_module

import pytest
import tyro
from places import ROOT
from run_folders import write_camera_path, write_scene, write_trained

pytest.importorskip("nerfstudio")

from beags_plugin.commands import cli
from beags_plugin.splat_io.ply import write_ply

DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
PROGRAMS = re.compile(r"^(?:[A-Z_]+=\S+ )*(beags|ns-[a-z-]+|make|pip|python) ")
SUBSTITUTES = {  # path in the documents: path in the test's folder
    "outputs/.../extracted/cup/config.yml": "run/extracted/cup/config.yml",
    "outputs/.../config.yml": "run/config.yml",
    "outputs/walk/run/config.yml": "run/config.yml",
    "outputs/.../nerfstudio_models": "run/nerfstudio_models",
    "outputs/...": "run",
}
RUN = {  # command of beags: flags appended to make it quick
    "extract": [],
    "eval": [],
    "export": ["--resolution", "24", "--min-views", "1"],
    "render": ["--size", "32", "--frames", "3", "--views", "2"],
    "sample": ["--width", "32", "--height", "24", "--views", "3"],
    "masks check": [],
}
PARSERS = {
    "ns-viewer": "nerfstudio.scripts.viewer.run_viewer:RunViewer",
    "ns-eval": "nerfstudio.scripts.eval:ComputePSNR",
    "ns-export": "nerfstudio.scripts.exporter:Commands",
    "ns-render": "nerfstudio.scripts.render:Commands",
}


def code_lines(text: str) -> list[str]:
    """Return the lines of fenced and indented code blocks, continued lines joined."""
    lines, fenced = [], False
    for line in text.replace("\\\n", " ").splitlines():
        if line.startswith("```"):
            fenced = not fenced
        elif fenced or line.startswith("    "):
            lines.append(line.strip())
    return lines


def commands_of(text: str) -> list[str]:
    """Return the commands of a document's code blocks, without synopses (which have brackets)."""
    return [line for line in code_lines(text) if PROGRAMS.match(line + " ") and not re.search(r"[\[\]<>]", line)]


COMMANDS = [
    (document.name, line)
    for document in DOCUMENTS
    if document.exists()
    for line in commands_of(document.read_text("utf8"))
]
pytestmark = pytest.mark.skipif(not COMMANDS, reason="no documents beside the tests")


def words_of(line: str) -> list[str]:
    for name, own in SUBSTITUTES.items():
        line = line.replace(name, own)
    words = shlex.split(line, comments=True)
    return words[next(i for i, word in enumerate(words) if "=" not in word or word.startswith("-")) :]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder with two runs of the data my_scene, and a scene to start from."""
    root = tmp_path_factory.mktemp("reader")
    write_scene(root / "my_scene")
    for name in ("run", "other"):
        config = write_trained(root / name, root / "my_scene")
    write_camera_path(root / "run/camera_paths/flight.json")
    from beags_plugin.objects.extract import extract_objects
    from beags_plugin.runs.run import Run

    extract_objects(config.parent.parent / "run/config.yml", ["cup"])
    write_ply(root / "scene.ply", Run(config).assigned.surfels())
    return root


def parsed_by_tyro(kind, words: list[str], **options):
    try:
        return tyro.cli(kind, args=words, **options)
    except SystemExit as end:
        raise AssertionError(f"{' '.join(words)} is refused") from end


def training_config(words: list[str]):
    """Return the config that ns-train makes of ``words``."""
    from beags_plugin.plugin.options.config import BeagsTrainerConfig
    from beags_plugin.plugin.presets import load_preset, preset_names

    preset, *flags = words
    assert preset in preset_names(), f"there is no preset {preset}"
    kind = tyro.conf.SuppressFixed[tyro.conf.FlagConversionOff[BeagsTrainerConfig]]
    return parsed_by_tyro(kind, flags, default=load_preset(preset).config)


def check_beags(words: list[str]) -> None:
    name = " ".join(words[:2]) if words[0] == "masks" else words[0]
    if name in RUN and "plane" not in words:  # the clouds of the test's run stand on nothing
        cli.main([*words, *([] if "--camera-path" in words else RUN[name])])  # a path has a size of its own
        return
    config = (tyro.conf.OmitArgPrefixes, tyro.conf.OmitSubcommandPrefixes)
    parsed_by_tyro(cli.all_commands(words), words, config=config)


def check_other(program: str, words: list[str]) -> None:
    if program == "ns-train":
        training_config(words)
    elif program in PARSERS:
        module, _, name = PARSERS[program].partition(":")
        parsed_by_tyro(getattr(import_module(module), name), words)
    elif program == "make":
        targets = {line.partition(":")[0] for line in (ROOT / "Makefile").read_text().splitlines() if ":" in line}
        assert {word for word in words if "=" not in word} <= targets
    elif program == "pip":
        for flag, file in zip(words, words[1:], strict=False):
            assert flag != "-c" or (ROOT / file).is_file(), f"{file} is not there"
    elif program == "python" and words[0] != "-m":
        script = (ROOT / words[0]).read_text("utf8")
        flags = [word[2:].replace("-", "_") for word in words if word.startswith("--")]
        known = script.replace("-", "_")
        assert all(flag in known or flag.removeprefix("no_") in known for flag in flags), words


@pytest.mark.parametrize(("document", "line"), COMMANDS, ids=[f"{name}: {line}" for name, line in COMMANDS])
def test_a_documented_command_works(folder, monkeypatch, document, line):
    monkeypatch.chdir(folder)
    program, *words = words_of(line)
    if program == "beags":
        check_beags(words)
    else:
        check_other(program, words)


def test_commands_in_the_text_exist():
    """Every `beags NAME` in the text is a subcommand."""
    known = {command.__name__.lower() for command in typing.get_args(cli.Command)} | {*cli.COMMANDS.names()}
    for document in DOCUMENTS:
        named = set(re.findall(r"`beags ([a-z][a-z-]+)", document.read_text("utf8")))
        assert named <= known, f"{document.name}: {named - known}"


def test_code_blocks_are_found():
    text = "a\n\n    ns-eval one \\\n        two\n\n```sh\nbeags x\n```\nbeags y\n"
    assert [re.sub(r"\s+", " ", line) for line in code_lines(text)] == ["ns-eval one two", "beags x"]
    assert words_of("OMP_NUM_THREADS=1 beags eval --load-config outputs/.../config.yml  # all") == [
        "beags", "eval", "--load-config", "run/config.yml",
    ]  # fmt: skip
