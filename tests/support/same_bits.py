"""Compare two runs, or two exports, bit for bit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch


def run_differences(whole: Path, run: Path) -> list[str]:
    """Return what differs between two complete runs: checkpoints and their content, base, masks and grids."""
    found = []
    for pattern in ("nerfstudio_models/*.ckpt", "base/nerfstudio_models/*.ckpt", "prepared/**/grid.pt"):
        found += _name_by_name(whole, run, pattern, _tensor_differences)
    found += _name_by_name(whole, run, "prepared/**/*.png", _byte_differences)
    return found + unfinished(run)


def export_differences(whole: Path, folder: Path) -> list[str]:
    """Return what differs between two finished exports."""
    return _name_by_name(whole, folder, "**/*", _byte_differences) + unfinished(folder)


def half_written(whole: Path, folder: Path) -> list[str]:
    """Return what of a killed export is neither absent nor as it should be; hidden files do not count."""
    files = [path for path in folder.rglob("*") if path.is_file() and not path.name.startswith(".")]
    return [str(path) for path in files if _byte_differences(whole / path.relative_to(folder), path)]


def unfinished(folder: Path) -> list[str]:
    """Return files that were begun and left."""
    return [f"left behind: {path}" for path in folder.rglob("*.part")]


def _name_by_name(one: Path, other: Path, pattern: str, differ) -> list[str]:
    names = [{path.relative_to(folder) for path in folder.glob(pattern) if path.is_file()} for folder in (one, other)]
    missing = [f"only in one: {name}" for name in sorted(names[0] ^ names[1])]
    if not names[0]:
        missing.append(f"the run without a kill has no {pattern}")
    return missing + [
        f"{name}{where}" for name in sorted(names[0] & names[1]) for where in differ(one / name, other / name)
    ]


def _byte_differences(one: Path, other: Path) -> list[str]:
    return [] if one.is_file() and one.read_bytes() == other.read_bytes() else [" has other bytes"]


def _tensor_differences(one: Path, other: Path) -> list[str]:
    return differences(*(without_clocks(torch.load(path, weights_only=True)) for path in (one, other)))


def without_clocks(value: Any) -> Any:
    """Return the same without the times of clocks."""
    if isinstance(value, dict):
        return {name: without_clocks(item) for name, item in value.items() if name != "seconds"}
    return [without_clocks(item) for item in value] if isinstance(value, (list, tuple)) else value


def differences(one: Any, other: Any, where: str = "") -> list[str]:
    """Return the places where two nested values differ in a bit."""
    if isinstance(one, torch.Tensor) and isinstance(other, torch.Tensor):
        same = one.dtype == other.dtype and one.shape == other.shape
        return [] if same and one.cpu().numpy().tobytes() == other.cpu().numpy().tobytes() else [where]
    if isinstance(one, dict) and isinstance(other, dict) and one.keys() == other.keys():
        return [found for key in one for found in differences(one[key], other[key], f"{where}/{key}")]
    if isinstance(one, list) and isinstance(other, list) and len(one) == len(other):
        pairs = enumerate(zip(one, other, strict=True))
        return [found for index, pair in pairs for found in differences(*pair, f"{where}/{index}")]
    return [] if one == other else [where or " differs"]
