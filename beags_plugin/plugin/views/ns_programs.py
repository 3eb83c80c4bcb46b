"""Prepare nerfstudio's programs for a method or a run of ours, before they import nerfstudio's own methods.

Nerfstudio loads data parsers of other packages long before their methods, so our data parser calls this.

One warning comes before any code of ours: of ``torch.jit.script`` in nerfstudio's cameras, which our data parser needs.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path
from typing import Any

from beags_plugin.system.errors import UserError, check_choice, meant, silence_libraries
from beags_plugin.system.pasted import command
from beags_plugin.system.program import path_option, program_name
from beags_plugin.system.shipped import shipped_names

PROGRAMS = ("ns-viewer", "ns-render", "ns-eval", "ns-export")
_OF_OURS = b"!!python/object:beags_plugin."
_VIDEOS = ("camera-path", "interpolate", "spiral")  # Modes of ns-render that need ffmpeg, even for images.


def prepare_reading() -> None:
    """Silence warnings in a program that opens a run of ours; exit from ns-render with one sentence if it would fail.

    Other programs, and runs of other methods, are left as they are.
    """
    path, program = path_option("--load-config"), program_name()
    if program not in PROGRAMS or path is None or not _is_ours(path):
        return
    silence_libraries()
    if program == "ns-render" and (sentence := _cannot_render(sys.argv[1], path)) is not None:
        print(f"beags: {sentence}", file=sys.stderr)
        sys.exit(2)


def _is_ours(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            return file.read(len(_OF_OURS)) == _OF_OURS
    except OSError:  # Nerfstudio reports it.
        return False


def _cannot_render(mode: str, config_path: Path) -> str | None:
    """Return why a mode of ns-render fails, and a command that works; None if the mode works."""
    words = ["beags", "render", "--load-config", str(config_path)]
    if mode == "spiral":  # It needs rays of single pixels, which splatfacto does not have either.
        return (
            "ns-render spiral needs a method that trains on single rays: use ns-render interpolate, or swing before "
            f"the objects with {command([*words, '--turn', '60'])}"
        )
    if mode not in _VIDEOS or shutil.which("ffmpeg") is not None:
        return None
    if mode == "camera-path":
        words += ["--camera-path", str(path_option("--camera-path-filename") or "camera_path.json")]
    if (output := path_option("--output-path")) is not None:
        words += ["--output", str(output)]
    path = "" if mode == "camera-path" else " and turns about the objects"
    return f"ns-render {mode} needs ffmpeg, which is not installed; this command needs none{path}: {command(words)}"


def prepare_training() -> None:
    """Make ns-train of a preset of ours quicker and quieter; exit with one sentence if the preset is misspelt.

    Other programs, and ns-train with other methods, are left as they are.
    """
    words = sys.argv[1:]
    name = words[0] if words else ""
    presets = shipped_names("method_configs")
    if program_name() != "ns-train" or not (name.startswith("beags") or meant(name, presets)):
        return
    try:
        check_choice(name, presets, "preset")
    except UserError as error:
        print(f"beags: {error}", file=sys.stderr)
        sys.exit(2)
    silence_libraries()
    leave_out_other_methods()


def leave_out_other_methods() -> None:
    """Skip nerfstudio's work at each start for methods other than ours.

    For every method that could be installed it walks over all modules of the process, and for one function of
    splatfacto it imports torch's compiler.
    """
    from nerfstudio.configs import external_methods
    from nerfstudio.utils import misc

    external_methods.external_methods.clear()

    def plain(*arguments: Any, **_: Any) -> Any:
        return arguments[0] if arguments else lambda function: function

    misc.torch_compile = plain
