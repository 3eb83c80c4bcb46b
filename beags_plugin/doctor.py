"""What works here and what is missing: the contents of ``beags doctor``."""

from __future__ import annotations

import platform
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True)
class Check:
    """One thing looked at.

    name: what. ok: whether it is there. sentence: what was found, or what to do. required: whether beags cannot
    run without it.
    """

    name: str
    ok: bool
    sentence: str
    required: bool = True


def diagnose() -> list[Check]:
    """Look at everything beags uses; never fails, whatever is missing or broken."""
    checks: list[Callable[[], Check]] = [
        _python,
        _torch,
        _cuda,
        _nerfstudio,
        _opencv,
        _open3d,
        *_rasterizers(),
        _compiler,
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
        return Check(name, False, f"cannot be used: {_first_line(error)}")


def _first_line(error: BaseException) -> str:
    text = str(error).strip()
    return f"{type(error).__name__}: {text.splitlines()[0]}" if text else type(error).__name__


def _python() -> Check:
    ok = (3, 10) <= sys.version_info[:2] <= (3, 12)
    advice = "" if ok else "; nerfstudio's dependencies need 3.10 to 3.12"
    return Check("python", ok, f"{platform.python_version()}, {platform.system()} {platform.machine()}{advice}")


def _torch() -> Check:
    import torch

    return Check("torch", True, f"{torch.__version__}, {torch.get_num_threads()} threads")


def _cuda() -> Check:
    import torch

    if torch.cuda.is_available():
        return Check("CUDA device", True, f"{torch.cuda.get_device_name(0)}; beags has no CUDA rasterizer yet", False)
    return Check("CUDA device", False, "none; not needed: the rasterizers run on the CPU", False)


def _nerfstudio() -> Check:
    from importlib.metadata import version

    import nerfstudio  # noqa: F401

    found = version("nerfstudio")
    if found != "1.1.5":
        return Check("nerfstudio", False, f"{found}, but the plugin is made for 1.1.5: run make setup")
    return Check("nerfstudio", True, found)


def _opencv() -> Check:
    import cv2

    # Plain opencv installed over contrib leaves an empty ximgproc, so look for the function itself.
    if not hasattr(getattr(cv2, "ximgproc", None), "guidedFilter"):
        advice = "reinstall opencv-contrib-python-headless==4.10.0.84 last"
        return Check("opencv contrib", False, f"{cv2.__version__} without cv2.ximgproc.guidedFilter: {advice}")
    return Check("opencv contrib", True, f"{cv2.__version__} with cv2.ximgproc.guidedFilter")


def _open3d() -> Check:
    try:
        import open3d
    except Exception as error:
        advice = "ns-export needs it; version 0.19.0 needs the system libraries libX11 and libGL"
        return Check("open3d", False, f"{_first_line(error)}; {advice}", False)
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
        reason = RASTERIZERS.get(name).unavailable()
    except Exception as error:
        return Check(title, False, _first_line(error), required)
    return Check(title, reason is None, reason or "can run here", required)


def _compiler() -> Check:
    for command in ("c++", "g++", "clang++"):
        if path := shutil.which(command):
            return Check("C++ compiler", True, path, False)
    return Check("C++ compiler", False, "none: needed only to build beags (Debian: apt install g++)", False)


def _ffmpeg() -> Check:
    if path := shutil.which("ffmpeg"):
        return Check("ffmpeg", True, path, False)
    return Check("ffmpeg", False, "not on PATH: ns-render cannot write videos (Debian: apt install ffmpeg)", False)


def print_report(checks: list[Check], console: Console | None = None) -> None:
    """Print the checks as a table: "ok", "missing" (beags cannot run) or "absent" (something optional)."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(show_header=False, box=None, padding=(0, 1))
    for check in checks:
        word, style = ("ok", "green") if check.ok else ("missing", "red") if check.required else ("absent", "yellow")
        table.add_row(Text(word, style=style), Text(check.name), Text(check.sentence))
    (console or Console()).print(table)
