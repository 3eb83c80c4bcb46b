"""Checks of the installation and of a scene."""

from __future__ import annotations

import platform
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

from beags_plugin.commands.doctor.backends import first_contact_check, rasterizers
from beags_plugin.commands.doctor.check import Check, first_line
from beags_plugin.commands.starting import NERFSTUDIO_REPAIR

_OPENCV = "pip install --force-reinstall --no-deps opencv-contrib-python-headless==4.10.0.84"
_REPAIRS = {  # Repair for a check that raises, by its name.
    "torch": "pip install torch",
    "nerfstudio": NERFSTUDIO_REPAIR,
    "opencv": _OPENCV,
    "presets": "pip install -c constraints.txt -e .",
}


def diagnose() -> Iterator[Check]:
    """Check everything that beags uses, quick checks first; never raises, whatever is missing or broken."""
    for check in (_python, _nvcc, _presets, _opencv, _masks, _torch, _cuda, _nerfstudio, _open3d):
        yield _safely(check)
    yield from map(_safely, rasterizers())
    yield _safely(first_contact_check)


def checks_of_data(data: Path | None) -> Iterator[Check]:
    """Check that a scene can be read, and that memory and disk are free for a training on it; nothing without one.

    Raises ``UserError`` for bad data.
    """
    if data is None:
        return
    import tempfile

    from beags_plugin.plugin.training.memory_guard import LEAST_FREE_MB, free_disk_mb
    from beags_plugin.system.memory import available_mb
    from beags_plugin.views.data_options import DataOptions
    from beags_plugin.views.scene_data import SceneData

    scene, output = SceneData(DataOptions(data=data)), Path("outputs")  # Nerfstudio's default folder.
    train, held_out = (len(scene.split(split).cameras) for split in ("train", "val"))
    free = {
        "memory": (available_mb(), "beside this program"),
        "disk": (free_disk_mb(output), f"for {output}"),
        "temporary disk": (free_disk_mb(temporary := Path(tempfile.gettempdir())), f"for {temporary}"),
    }
    yield Check("data", True, f"{train} views to train on, {held_out} held out")
    for name, (amount, place) in free.items():
        yield Check(name, amount >= LEAST_FREE_MB, f"{amount / 1000:.1f} GB are free {place}", False)


def _safely(check: Callable[[], Check]) -> Check:
    try:
        return check()
    # A broken native library may raise anything, even SystemExit.
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        name = getattr(check, "__name__", "check").strip("_")
        return Check(name, False, f"cannot be used: {first_line(error)}", repair=_REPAIRS.get(name, ""))


def _python() -> Check:
    ok = (3, 10) <= sys.version_info[:2] <= (3, 12)
    advice = "" if ok else "; nerfstudio's dependencies need 3.10 to 3.12"
    sentence = f"{platform.python_version()}, {platform.system()} {platform.machine()}{advice}"
    return Check("python", ok, sentence, repair="" if ok else "PYTHON=python3.11 make setup")


def _torch() -> Check:
    import torch

    return Check("torch", True, f"{torch.__version__}, {torch.get_num_threads()} threads")


def _nerfstudio() -> Check:
    from importlib.metadata import version
    from importlib.util import find_spec

    if find_spec("nerfstudio") is None:
        raise ModuleNotFoundError("No module named 'nerfstudio'")
    ok = (installed := version("nerfstudio")) == "1.1.5"
    sentence = installed if ok else f"{installed}, but the plugin is made for 1.1.5"
    return Check("nerfstudio", ok, sentence, repair="" if ok else _REPAIRS["nerfstudio"])


def _presets() -> Check:
    from importlib.metadata import entry_points

    names = [point.name for point in entry_points(group="nerfstudio.method_configs") if point.name.startswith("beags")]
    if not names:
        return Check("presets", False, "ns-train does not know any preset of beags", repair=_REPAIRS["presets"])
    return Check("presets", True, f"ns-train knows {', '.join(sorted(names))}")


def _opencv() -> Check:
    import cv2

    # Plain opencv installed over contrib leaves an empty ximgproc, so the function itself is checked.
    ok = hasattr(getattr(cv2, "ximgproc", None), "guidedFilter")
    sentence = f"{cv2.__version__} {'with' if ok else 'without'} cv2.ximgproc.guidedFilter"
    return Check("opencv contrib", ok, sentence, repair="" if ok else _OPENCV)


def _masks() -> Check:
    from beags_plugin.masks.sources.salient import SalientSource, weights_folder

    name = "masks of photos"
    if reason := SalientSource.unavailable():
        return Check(name, False, reason.partition(":")[0], False, "pip install onnxruntime")
    weights = weights_folder() / "u2netp.onnx"
    if not weights.is_file():
        return Check(
            name, False, "no weights yet; the first demo from photos fetches 4.6 MB", False, "beags masks weights"
        )
    return Check(name, True, f"onnxruntime with {weights}", False)


def _open3d() -> Check:
    try:
        import open3d
    except Exception as error:
        absent = isinstance(error, ModuleNotFoundError)
        repair = "pip install open3d==0.19.0" if absent else "apt install libx11-6 libgl1"
        return Check("open3d", False, f"{first_line(error)}; exported meshes and close_contacts need it", False, repair)
    return Check("open3d", True, open3d.__version__, False)


def _cuda() -> Check:
    import torch

    if torch.cuda.is_available():
        major, minor = torch.cuda.get_device_capability(0)
        return Check("CUDA device", True, f"{torch.cuda.get_device_name(0)}, sm_{major}{minor}", False)
    return Check("CUDA device", False, "none; not needed: the rasterizers run on the CPU", False)


def _nvcc() -> Check:
    path = shutil.which("nvcc")
    return Check("nvcc", path is not None, path or "none on PATH; only building the CUDA rasterizer needs it", False)
