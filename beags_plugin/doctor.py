"""What works here and what is missing: the contents of ``beags doctor``."""

from __future__ import annotations

import json
import os
import platform
import shutil
import signal
import subprocess
import sys
import sysconfig
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True)
class Check:
    """One thing looked at.

    name: what. ok: whether it is there. sentence: what was found, or what to do. required: whether beags cannot
    run without it. repair: the one command that mends it, or "" where it is there or no command does.
    """

    name: str
    ok: bool
    sentence: str
    required: bool = True
    repair: str = ""

    def to_json(self) -> dict[str, object]:
        """Plain values by name."""
        return asdict(self)


_OPENCV = "pip install --force-reinstall --no-deps opencv-contrib-python-headless==4.10.0.84"
_REBUILD = "pip install --force-reinstall --no-deps ."  # in the folder of the clone
_REPAIRS = {  # by the name of what cannot even be looked at
    "torch": "pip install torch",
    "nerfstudio": "pip install nerfstudio==1.1.5",
    "opencv": _OPENCV,
    "presets": "pip install -c constraints.txt -e .",
}


def diagnose() -> list[Check]:
    """Look at everything beags uses; never fails, whatever is missing or broken."""
    checks: list[Callable[[], Check]] = [
        _python,
        _torch,
        _nerfstudio,
        _presets,
        _opencv,
        _open3d,
        _cpu,
        _cuda,
        *_rasterizers(),
        _compiler,
        _pictures,
        _films,
        _formats,
        _ffmpeg,
    ]
    return [_safely(check) for check in checks]


def _safely(check: Callable[[], Check]) -> Check:
    try:
        return check()
    # BaseException but for Ctrl-C: a broken native library may raise anything, SystemExit too.
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        name = getattr(check, "__name__", "check").strip("_")
        return Check(name, False, f"cannot be used: {_first_line(error)}", repair=_REPAIRS.get(name, ""))


def _first_line(error: BaseException) -> str:
    text = str(error).strip()
    return f"{type(error).__name__}: {text.splitlines()[0]}" if text else type(error).__name__


def _python() -> Check:
    ok = (3, 10) <= sys.version_info[:2] <= (3, 12)
    advice = "" if ok else "; nerfstudio's dependencies need 3.10 to 3.12"
    sentence = f"{platform.python_version()}, {platform.system()} {platform.machine()}{advice}"
    return Check("python", ok, sentence, repair="" if ok else "PYTHON=python3.11 make setup")


def _torch() -> Check:
    import torch

    return Check("torch", True, f"{torch.__version__}, {torch.get_num_threads()} threads")


def _cuda() -> Check:
    import torch

    if torch.cuda.is_available():
        major, minor = torch.cuda.get_device_capability(0)
        return Check("CUDA device", True, f"{torch.cuda.get_device_name(0)}, sm_{major}{minor}", False)
    return Check("CUDA device", False, "none; not needed: the rasterizers run on the CPU", False)


def _cpu() -> Check:
    cores = os.cpu_count() or 1
    waiting = os.environ.get("OMP_WAIT_POLICY", "unset")
    return Check("CPU", True, f"{cores} cores; OMP_WAIT_POLICY is {waiting} (PASSIVE is best where others compute too)")


def _presets() -> Check:
    from importlib.metadata import entry_points

    found = [point.name for point in entry_points(group="nerfstudio.method_configs") if point.name.startswith("beags")]
    if not found:
        return Check("presets", False, "ns-train does not know any preset of beags", repair=_REPAIRS["presets"])
    return Check("presets", True, f"ns-train knows {', '.join(sorted(found))}")


def _pictures() -> Check:
    """Photos and masks: PNG must come back exactly."""
    import cv2
    import numpy as np

    image = np.arange(8 * 8 * 3, dtype=np.uint8).reshape(8, 8, 3)
    for suffix, exact in ((".png", True), (".jpg", False)):
        done, content = cv2.imencode(suffix, image)
        back = cv2.imdecode(content, cv2.IMREAD_UNCHANGED) if done else None
        if back is None or back.shape != image.shape or (exact and not np.array_equal(back, image)):
            return Check("codecs png, jpg", False, f"{suffix} images do not come back", repair=_OPENCV)
    return Check("codecs png, jpg", True, "read and written")


def _films() -> Check:
    from beags_plugin.turntable.video import REPAIR, encoder

    name = encoder()
    if name is None:
        return Check("codec mp4", False, "beags render can write .gif only", False, REPAIR)
    browsers = "" if name != "mpeg4" else "; browsers do not show it, players do"
    return Check("codec mp4", True, f"{name}{browsers}", False)


def _formats() -> Check:
    from beags_plugin.export import EXPORTERS

    reasons = {name: EXPORTERS.get(name).unavailable() for name in EXPORTERS.names()}
    ready = ", ".join(name for name, reason in reasons.items() if reason is None)
    if missing := {name: reason for name, reason in reasons.items() if reason is not None}:
        sentence = f"{ready}; not {', '.join(missing)}: {next(iter(missing.values()))}"
        return Check("export formats", False, sentence, False, "pip install open3d==0.19.0")
    return Check("export formats", True, ready, False)


def _nerfstudio() -> Check:
    from importlib.metadata import version

    import nerfstudio  # noqa: F401

    found = version("nerfstudio")
    if found != "1.1.5":
        sentence = f"{found}, but the plugin is made for 1.1.5: run make setup"
        return Check("nerfstudio", False, sentence, repair=_REPAIRS["nerfstudio"])
    return Check("nerfstudio", True, found)


def _opencv() -> Check:
    import cv2

    # Plain opencv installed over contrib leaves an empty ximgproc, so look for the function itself.
    if not hasattr(getattr(cv2, "ximgproc", None), "guidedFilter"):
        advice = "reinstall opencv-contrib-python-headless==4.10.0.84 last"
        sentence = f"{cv2.__version__} without cv2.ximgproc.guidedFilter: {advice}"
        return Check("opencv contrib", False, sentence, repair=_OPENCV)
    return Check("opencv contrib", True, f"{cv2.__version__} with cv2.ximgproc.guidedFilter")


def _open3d() -> Check:
    try:
        import open3d
    except Exception as error:
        advice = "ns-export and exported meshes need it; version 0.19.0 needs the system libraries libX11 and libGL"
        absent = isinstance(error, ModuleNotFoundError)
        repair = "pip install open3d==0.19.0" if absent else "apt install libx11-6 libgl1"
        return Check("open3d", False, f"{_first_line(error)}; {advice}", False, repair)
    return Check("open3d", True, open3d.__version__, False)


def _rasterizers() -> list[Callable[[], Check]]:
    try:
        from beags_plugin.rasterizers import RASTERIZERS

        names = RASTERIZERS.names()
    except Exception as error:
        sentence = f"cannot be listed: {_first_line(error)}"
        return [lambda: Check("rasterizers", False, sentence)]
    return [lambda name=name: _rasterizer(name) for name in names]


def _rasterizer(name: str) -> Check:
    from beags_plugin.rasterizers import RASTERIZERS

    title, required = f"rasterizer {name}", name == "torch"
    try:
        if not required:
            return replace(_try_in_process(name), name=title, required=False)
        reason = RASTERIZERS.get(name).unavailable()
    except Exception as error:
        return Check(title, False, _first_line(error), required)
    return Check(title, reason is None, reason or "can run here", required)


# Draws one surfel, there and back: code for another processor is found only when it runs.
_TRIAL = """
import json, sys
sys.path[:] = json.loads(sys.argv[1])
from beags_plugin.errors import UserError
from beags_plugin.rasterizers import RASTERIZERS, make_rasterizer
name = sys.argv[2]
reason = None
try:
    reason = RASTERIZERS.get(name).unavailable()
    rasterizer = make_rasterizer(name)
    import torch
    from beags_plugin.core.cameras import Camera
    from beags_plugin.rasterizers.interface import RasterSettings, SurfelInputs
    K = torch.tensor([[9.0, 0.0, 4.0], [0.0, 9.0, 4.0], [0.0, 0.0, 1.0]])
    values = (torch.tensor([[0.0, 0.0, 1.0]]), torch.ones(1, 4), torch.full((1, 2), -2.0), torch.zeros(1),
              torch.ones(1, 3), torch.zeros(3))
    *values, background = (value.to("cuda" if name == "cuda" else "cpu") for value in values)
    inputs = SurfelInputs(values[0].requires_grad_(), *values[1:])
    render = rasterizer.rasterize(inputs, Camera(torch.eye(4), K, 8, 8), RasterSettings(0.1, 9.0), background)
    render.color.sum().backward()
    assert render.alpha.max() > 0.1, "it draws nothing"
    native = sys.modules.get("beags_plugin._native") if name == "native" else None
    kernels = f", with {native.instruction_set()} kernels" if native else ""
    print(json.dumps([True, "can run here" + kernels, False]))
except UserError as error:
    # with a reason "auto" draws with another backend; an instruction set that was asked for in vain stops everything
    print(json.dumps([False, reason or str(error), reason is not None]))
"""


_AVOIDED = {  # how to do without a backend that fails
    "native": "BEAGS_NATIVE=0 in the environment avoids it",
    "cuda": "training with --machine.device-type cpu, the default, avoids it",
}


def _try_in_process(name: str) -> Check:
    """Draw with the backend in a process of its own, which may die without taking the doctor along."""
    avoided = _AVOIDED.get(name, "--pipeline.model.rasterizer torch avoids it")
    done = subprocess.run(
        [sys.executable, "-c", _TRIAL, json.dumps(sys.path), name], capture_output=True, text=True, timeout=120
    )
    if done.returncode < 0:
        processor, killer = "GPU" if name == "cuda" else "processor", signal.Signals(-done.returncode).name
        cause = f"it ends with {killer}, so it is damaged or made for another {processor}"
        sentence = f"{cause}: reinstall beags from source; {avoided}"
        return Check(name, False, sentence, repair=_REBUILD)
    lines = done.stdout.strip().splitlines()
    if done.returncode != 0 or not lines:
        last = (done.stderr.strip().splitlines() or ["no message"])[-1]
        sentence = f"it fails when it draws: {last}; {avoided}"
        return Check(name, False, sentence, repair=_REBUILD)
    ok, sentence, replaced = json.loads(lines[-1])
    if replaced and name == "native":
        sentence = f"{sentence.rstrip('.')}; until then the torch reference draws, some hundred times slower"
    return Check(name, ok, sentence, repair=_REBUILD if replaced and name == "native" else "")


def _compiler() -> Check:
    advice = "(Debian: apt install g++; macOS: xcode-select --install) and reinstall beags"
    named = os.environ.get("CXX", "").split()[:1]  # CXX may hold options after the command
    for command in named or ("c++", "g++", "clang++"):
        if path := shutil.which(command):
            return _compiles(path, advice)
    missing = f"CXX names {named[0]}, which is not there" if named else "none"
    sentence = f"{missing}: to build the fast rasterizer, install one {advice}"
    return Check("C++ compiler", False, sentence, False, _compiler_command())


def _compiler_command() -> str:
    return "xcode-select --install" if platform.system() == "Darwin" else "apt install g++"


def _compiles(path: str, advice: str) -> Check:
    """Whether the compiler does what the build asks of it: C++17, Python's headers, OpenMP."""

    def accepts(source: str, *options: str) -> bool:
        command = [path, "-std=c++17", "-fsyntax-only", *options, "-x", "c++", "-"]
        return subprocess.run(command, input=source, capture_output=True, text=True, timeout=60).returncode == 0

    if not accepts("#include <optional>\nstd::optional<int> value;\n"):
        sentence = f"{path} does not know C++17: install a newer one {advice}"
        return Check("C++ compiler", False, sentence, False, _compiler_command())
    headers = sysconfig.get_paths()["include"]
    if not accepts("#include <Python.h>\n", f"-I{headers}"):
        sentence = f"{path}, but Python's headers are not in {headers}: install them (Debian: apt install python3-dev)"
        return Check("C++ compiler", False, sentence, False, "apt install python3-dev")
    if not accepts("#include <omp.h>\n", "-fopenmp"):
        return Check("C++ compiler", True, f"{path}, without OpenMP: what it builds uses one thread", False)
    return Check("C++ compiler", True, path, False)


def _ffmpeg() -> Check:
    if path := shutil.which("ffmpeg"):
        return Check("ffmpeg", True, path, False)
    sentence = "not on PATH: ns-render cannot write videos (Debian: apt install ffmpeg); beags render can"
    return Check("ffmpeg", False, sentence, False, "apt install ffmpeg")


def print_report(checks: list[Check], console: Console | None = None) -> None:
    """Print the checks as a table: "ok", "missing" (beags cannot run) or "absent" (something optional).

    Below what does not work stands the one command that repairs it.
    """
    from rich.console import Console
    from rich.table import Column, Table
    from rich.text import Text

    table = Table("", "", Column(overflow="fold"), show_header=False, box=None, padding=(0, 1))
    for check in checks:
        word, style = ("ok", "green") if check.ok else ("missing", "red") if check.required else ("absent", "yellow")
        table.add_row(Text(word, style=style), Text(check.name), Text(check.sentence))
        if check.repair:
            table.add_row("", "", Text(f"repair: {check.repair}", style="bold"))
    (console or Console()).print(table)
