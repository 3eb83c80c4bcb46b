"""Fixtures that all tests share."""

from __future__ import annotations

import os
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import pytest
import torch
from every_backend import compiled, rasterizer  # noqa: F401
from hypothesis import settings
from shared_folders import shared_folder

from beags_plugin.ops import extension
from beags_plugin.plugin.views.ns_programs import leave_out_other_methods
from beags_plugin.sample import desk

if find_spec("nerfstudio"):
    leave_out_other_methods()  # in a process with the modules of all tests, nerfstudio's start took 14 seconds

settings.register_profile("beags", deadline=None)  # a busy machine is no failure
settings.load_profile("beags")


def pytest_sessionstart(session):
    """`make test` builds the extension first: there its tests must run, not be skipped."""
    if os.environ.get("BEAGS_REQUIRE_NATIVE") and extension.load() is None:
        pytest.exit(f"BEAGS_REQUIRE_NATIVE is set, but {extension.status()[1]}", returncode=1)


LONG = {  # files that take minutes: begun first, so that no process waits for them at the end
    "tests/commands/test_end_to_end.py", "tests/commands/test_readme_commands.py", "tests/test_wheel.py",
    "benchmarks/tests/experiments/test_ray_cluster.py", "tests/plugin/viewer/test_viewer_browser.py",
    "tests/plugin/viewer/test_viewer_browser_runs.py",
}  # fmt: skip
SPREAD = {
    "tests/mistakes/test_mistakes.py", "tests/plugin/training/test_resume.py",
    "tests/plugin/training/test_started_runs.py",
}  # fmt: skip
"""Files whose tests any process may run; each other file runs in one process, which makes its fixtures once."""


def file_of(nodeid: str) -> str:
    return nodeid.partition("::")[0]


def pytest_collection_modifyitems(items):
    """Begin long files first; tests that any process may run come last and fill the gaps."""
    for item in items:
        for mark in item.iter_markers("slow"):
            assert len(mark.args) == 1 and not mark.kwargs, f"{item.nodeid}: @pytest.mark.slow(why it must be)"
    items.sort(key=lambda item: (file_of(item.nodeid) in SPREAD, file_of(item.nodeid) not in LONG))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """Let pytest-xdist hand out files, and single tests of those in ``SPREAD``."""
    from xdist.scheduler import LoadScopeScheduling

    class ByFile(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return nodeid if file_of(nodeid) in SPREAD else file_of(nodeid)

    return ByFile(config, log) if config.getvalue("dist") == "loadscope" else None


@pytest.fixture(scope="session")
def shared(tmp_path_factory):
    """``shared(name, make)``: the folder that ``make`` filled, once for all processes; tests only read it."""
    return partial(shared_folder, tmp_path_factory)


@pytest.fixture(scope="session")
def short_run(shared):
    """A folder with ``data`` and ``run``: a whole run of all phases, as ``resumed_runs.short_config`` describes it."""
    pytest.importorskip("nerfstudio")
    from resumed_runs import run_to_end, short_config
    from run_folders import write_scene

    def train(folder: Path) -> None:
        run_to_end(short_config(write_scene(folder / "data"), folder / "run"))

    return shared("short_run", train)


@pytest.fixture(scope="session", autouse=True)
def coarse_light():
    """Measure the light of generated desks at fewer points: that took most of a small sample's time.

    Yields the product's own distances of those points, by their names.
    """
    own = {name: value for name, value in vars(desk).items() if name.startswith("SPACING_")}
    with pytest.MonkeyPatch.context() as patch:
        for name, value in own.items():
            patch.setattr(desk, name, 4.0 * value)
        yield own


@pytest.fixture
def fine_light(coarse_light, monkeypatch):
    """The light of generated desks as users get it."""
    for name, value in coarse_light.items():
        monkeypatch.setattr(desk, name, value)


@pytest.fixture(params=["torch", "compiled"])
def ops(request, monkeypatch):
    """The torch versions of the ops, then the compiled ones; skipped where those were not built."""
    if request.param == "torch":
        monkeypatch.setattr(extension, "load", lambda: None)
    elif extension.load() is None:
        pytest.skip("beags_plugin._native was not built")
    return request.param


@pytest.fixture
def without_extension(monkeypatch):
    """A function that computes something as if the extension were absent."""

    def compute(call):
        with monkeypatch.context() as patch:
            patch.setattr(extension, "load", lambda: None)
            return call()

    return compute


@pytest.fixture
def for_threads():
    """A function that computes something on 1, 2 and 4 threads, and returns the three results."""
    before = torch.get_num_threads()

    def compute(call):
        results = []
        for count in (1, 2, 4):
            torch.set_num_threads(count)
            results.append(call())
        return results

    yield compute
    torch.set_num_threads(before)
