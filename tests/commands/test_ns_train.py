"""``ns-train`` with our methods, as the shell runs it: quick to start, quiet, and with an answer to a typo."""

from __future__ import annotations

import os
import re
import subprocess
import sys

import pytest
from places import ROOT

pytest.importorskip("nerfstudio")

from beags_plugin.plugin.views.ns_programs import prepare_training

ENTRY = """
import atexit, sys
from nerfstudio.scripts.train import entrypoint
from nerfstudio.configs.external_methods import external_methods
atexit.register(lambda: print(len(external_methods), "torch._inductor.compile_fx" in sys.modules, file=sys.stderr))
entrypoint()
"""
BEFORE_PLUGINS = r".*torch/jit/_script.py:.*\n  warnings.warn\(\n"
"""A warning of new versions of torch about what nerfstudio does before it looks for plugins."""


@pytest.fixture(scope="module")
def ns_train(tmp_path_factory):
    """Return a function that runs a program called ns-train with this checkout's package."""
    script = tmp_path_factory.mktemp("bin") / "ns-train"
    script.write_text(ENTRY)

    def run(*words: str) -> subprocess.CompletedProcess[str]:
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path[1:]])}
        return subprocess.run(
            [sys.executable, str(script), *words], capture_output=True, text=True, env=environment, timeout=600
        )

    return run


@pytest.mark.slow("starts ns-train, which imports for seconds")
def test_help_imports_nothing_for_other_methods_and_warns_of_nothing(ns_train):
    done = ns_train("beags", "--help")
    assert done.returncode == 0 and "The options that people set first" in done.stdout
    assert "--overwrite" in done.stdout
    said = re.sub(BEFORE_PLUGINS, "", done.stderr)
    assert said.split() == ["0", "False"]


@pytest.mark.slow("starts ns-train, which imports for seconds")
def test_a_misspelt_preset_is_answered_with_the_presets(ns_train):
    done = ns_train("beags-fsat", "--data", "x")
    assert done.returncode == 2 and done.stdout == ""
    (said,) = re.sub(BEFORE_PLUGINS, "", done.stderr).splitlines()[:1]
    assert said.startswith("beags: there is no preset 'beags-fsat' (did you mean beags-fast?): choose one of beags, ")


@pytest.mark.parametrize("words", [["ns-train", "splatfacto"], ["ns-train"], ["ns-eval", "beags-fsat"]])
def test_other_methods_and_programs_are_left_as_they_are(monkeypatch, words):
    from nerfstudio.configs import external_methods
    from nerfstudio.utils import misc

    monkeypatch.setattr(sys, "argv", words)
    monkeypatch.setattr(external_methods, "external_methods", ["another"])  # conftest.py has left out nerfstudio's own
    before = misc.torch_compile
    prepare_training()
    assert external_methods.external_methods == ["another"] and misc.torch_compile is before


def test_letters_that_changed_places_are_a_preset_too(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["/bin/ns-train", "begas-fast"])
    with pytest.raises(SystemExit) as end:
        prepare_training()
    assert end.value.code == 2 and "did you mean beags-fast?" in capsys.readouterr().err
