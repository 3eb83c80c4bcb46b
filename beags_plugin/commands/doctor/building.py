"""What it takes to build the compiled rasterizer."""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sysconfig

from beags_plugin.commands.doctor.check import Check


def compiler() -> Check:
    """Whether the compiled backend could be built here."""
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
