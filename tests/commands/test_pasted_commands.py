"""Commands that are printed can be pasted, also where paths hold spaces and brackets."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
from places import ROOT
from run_folders import write_scene, write_trained

pytest.importorskip("nerfstudio")

from beags_plugin.commands.cli import main
from beags_plugin.system.errors import UserError

_COMMAND = re.compile(r"(?:\s--[a-z-]+|beags resume|beags view|ns-train|ns-render|git [a-z ]+) (?:[a-z_]+=)?\{(\w+)")
SAFE = {"quoted", "command", "address", "mode"}  # address: a URL; mode: of ns-render; words in capitals are our own


def test_no_source_prints_a_path_into_a_command_unquoted():
    found = []
    for path in sorted((ROOT / "beags_plugin").rglob("*.py")):
        for number, line in enumerate(path.read_text("utf8").splitlines(), 1):
            for match in _COMMAND.finditer(line):
                if match[1] not in SAFE and not match[1].isupper() and '"' in line:
                    found.append(f"{path.relative_to(ROOT)}:{number}: {line.strip()}")
    assert not found, "\n".join(found)


def pasted(printed: str, start: str) -> list[str]:
    line = next(line for line in printed.splitlines() if start in line)
    return shlex.split(line[line.index(start) :])


def test_the_viewers_command_of_extracted_objects(tmp_path, capsys):
    folder = tmp_path / "my lab [1] (copy)"
    config = write_trained(folder / "run", write_scene(folder / "scene"))
    main(["extract", "--load-config", str(config), "--object", "cup", "--keep-all"])
    words = pasted(capsys.readouterr().out, "beags view")
    assert words[:2] == ["beags", "view"] and Path(words[2], "config.yml").is_file() and len(words) == 3


def test_the_command_after_poses(tmp_path, capsys, monkeypatch):
    from beags_plugin.commands import process

    monkeypatch.setattr(process, "find_poses", lambda *_: [])
    output, masks = tmp_path / "my scene [1]", tmp_path / "my masks"
    process.Process(data=tmp_path, output_dir=output, masks=masks).run()
    words = pasted(capsys.readouterr().out, "ns-train")
    assert words == [
        *("ns-train", "beags-fast", "--data", str(output), "--pipeline.datamanager.photos", "objects"),
        *("beags-data", "--masks-path", str(masks)),
    ]


def test_the_command_of_a_base_without_classes(tmp_path):
    from beags_plugin.runs.run import Run

    folder = tmp_path / "my run [1]"
    config = write_trained(folder, write_scene(tmp_path / "scene"), assigned=False)
    with pytest.raises(UserError, match="refine it first") as raised:
        _ = Run(config).assigned
    command = re.search(r"\((ns-train .*)\)\.$", str(raised.value))
    assert command is not None
    assert Path(shlex.split(command[1])[-1]).parent == folder
