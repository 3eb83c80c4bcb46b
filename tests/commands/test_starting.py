"""Mistakes are refused before torch is imported, and a command shows at once that it has begun."""

from __future__ import annotations

import json
import os
import pty
import subprocess
import sys

import pytest
from run_folders import write_scene, write_trained

from beags_plugin.commands.cli import Doctor, main
from beags_plugin.commands.starting import run_config, starting
from beags_plugin.system.errors import UserError, check_choice

pytest.importorskip("nerfstudio")

RUN = "{tmp}/run"
AT_ONCE = {  # arguments: the beginning of the sentence
    "demo --data {tmp}/nowhere": "the data folder {tmp}/nowhere does not exist",
    "demo --preset beags-fats": "there is no preset 'beags-fats' (did you mean beags-fast?)",
    "resume {tmp}/absent.yml": "{tmp}/absent.yml cannot be read",
    "masks check --data {tmp}/nowhere": "the data folder {tmp}/nowhere does not exist",
    "masks check --data {tmp}/lab --layout colmpa": "there is no layout 'colmpa' (did you mean colmap?)",
    "masks make --data {tmp}/lab --source salinet": "there is no mask source 'salinet' (did you mean salient?)",
    "extract --load-config {tmp}/absent.yml": "{tmp}/absent.yml cannot be read",
    "extract --load-config {tmp}/lab": "{tmp}/lab/config.yml cannot be read",
    f"export --load-config {RUN} --all --format step": "there is no exporter 'step'",
    "render --load-config {tmp}/notes.yml": "{tmp}/notes.yml is not a run of ns-train beags",
    f"render --load-config {RUN} --format sheets": "there is no format 'sheets' (did you mean sheet?)",
    "eval --load-config {tmp}/notes.yml": "{tmp}/notes.yml is not a run of ns-train beags",
    "doctor --data {tmp}/nowhere": "the data folder {tmp}/nowhere does not exist",
}
SCRIPT = """
import contextlib, io, json, sys
from beags_plugin.commands import cli
said = []
for arguments in json.load(sys.stdin):
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.suppress(SystemExit):
        cli.CONSOLE.file = out
        cli.main(arguments)
    heavy = sorted({"torch", "nerfstudio", "open3d", "cv2"} & set(sys.modules))
    said.append([out.getvalue(), heavy])
json.dump(said, sys.__stdout__)
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    root = tmp_path_factory.mktemp("starting")
    write_trained(root / "run", write_scene(root / "lab"))
    (root / "notes.yml").write_text("a: 1")
    return root


def test_mistakes_are_refused_before_anything_heavy_is_imported(folder):
    arguments = json.dumps([row.replace("{tmp}", str(folder)).split() for row in AT_ONCE])
    done = subprocess.run([sys.executable, "-c", SCRIPT], input=arguments, capture_output=True, text=True, check=True)
    for (row, sentence), (said, heavy) in zip(AT_ONCE.items(), json.loads(done.stdout), strict=True):
        assert said.replace(str(folder), "{tmp}").startswith(f"beags: {sentence}"), f"{row}: {said}"
        assert not heavy, f"{row} imported {heavy} first"


@pytest.mark.parametrize("words", ["demo", "resume {tmp}/run", "view {tmp}/run", "clean a.ply --data {tmp}/lab"])
def test_commands_that_need_nerfstudio_say_so_where_it_is_not_installed(folder, words, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "nerfstudio", None)
    with pytest.raises(SystemExit) as ended:
        main(words.replace("{tmp}", str(folder)).split())
    said = " ".join(capsys.readouterr().out.split())
    assert ended.value.code == 2 and said == (
        f"beags: beags {words.split()[0]} needs nerfstudio, which is not installed here: pip install "
        "nerfstudio==1.1.5, or use the environment of make setup."
    )


def test_a_terminal_shows_that_the_command_has_begun(folder):
    controller, terminal = pty.openpty()
    command = [sys.executable, "-m", "beags_plugin.commands.cli", "extract", "--load-config", str(folder / "run")]
    with subprocess.Popen(command, stdin=terminal, stdout=terminal, stderr=terminal, cwd=folder) as process:
        os.close(terminal)
        first = b""
        while b"starting" not in first and (more := os.read(controller, 1024)):
            first += more
        process.kill()
    os.close(controller)
    assert b"extracting" not in first and b"Gaussians" not in first


def test_a_run_may_be_named_by_its_folder(folder):
    assert run_config(folder / "run") == run_config(folder / "run/config.yml") == folder / "run/config.yml"


def test_the_nearest_choice_is_named_whatever_its_case():
    with pytest.raises(
        UserError, match=r"^there is no object 'Milk' in it \(did you mean milk\?\): choose one of milk, lemon\.$"
    ):
        check_choice("Milk", ["milk", "lemon"], "object", " in it")
    check_choice("milk", ["milk"], "object")


END = """
import atexit, sys, types
from beags_plugin.commands import cli

class Late:
    def __del__(self):
        print("destroyed")

late = Late()
for name in sys.argv[1:]:
    sys.modules[name] = types.ModuleType(name)
atexit.register(print, "at exit")
print("work", end=" ")
cli.end_process()
"""


@pytest.mark.parametrize(
    ("loaded", "said"),
    [
        (["torch"], "work at exit\n"),
        (["torch", "nerfstudio"], "work at exit\ndestroyed\n"),
        ([], "work at exit\ndestroyed\n"),
    ],
)
def test_a_process_with_torch_alone_ends_without_destructors(loaded, said):
    done = subprocess.run([sys.executable, "-c", END, *loaded], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == (said, "")


@pytest.mark.parametrize("without", ["sys.stdout = None", "sys.stdout.close()"])
def test_a_process_without_output_ends_in_success(without):
    end = END.replace("cli.end_process()", f"{without}; cli.end_process()").replace('print, "at exit"', "int")
    done = subprocess.run([sys.executable, "-c", end, "torch"], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize(("training", "policy"), [(False, "PASSIVE"), (True, None)])
def test_threads_of_commands_that_do_not_train_wait_passively(monkeypatch, training, policy):
    monkeypatch.setenv("OMP_WAIT_POLICY", "ACTIVE")
    with starting(Doctor(), training):
        assert os.environ["OMP_WAIT_POLICY"] == "ACTIVE"  # The user's choice stands.
    monkeypatch.delenv("OMP_WAIT_POLICY")
    with starting(Doctor(), training):
        assert os.environ.get("OMP_WAIT_POLICY") == policy
    monkeypatch.setenv("OMP_WAIT_POLICY", "")  # restored at the end, which deletes what ``starting`` set
