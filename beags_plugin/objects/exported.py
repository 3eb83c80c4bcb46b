"""Records of exported files, for users and manifests."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from beags_plugin.cleaning.clean import LeftOut
from beags_plugin.surfaces.closing_gaussians import Added
from beags_plugin.system.wording import amount


@dataclass(frozen=True)
class ExportedFile:
    """One file: its format, its path and its exporter's facts. path: None if nothing was written, for ``reason``."""

    format: str
    path: Path | None
    facts: dict[str, Any]
    reason: str = ""

    def __str__(self) -> str:
        """Return a line for users."""
        if self.path is None:
            return f"no {self.format}: {self.reason}"
        facts, parts = self.facts, []
        if "triangles" in facts:
            parts.append(f"{facts['triangles']:,} triangles")
        if isinstance(mesh := facts.get("mesh"), str):
            parts.append(f"no mesh{mesh.removeprefix('none')}")
        if isinstance(texture := facts.get("texture"), dict):
            size, share = texture["size"], texture["from_photos"]
            parts.append(f"a texture of {size} x {size}, {share:.0%} of it from photos")
        elif isinstance(texture, str) and texture != "none":
            parts.append(f"no texture{texture.removeprefix('none')}")
        if "sides" in facts:
            parts.append(" x ".join(f"{side:.1f}" for side in facts["sides"]) + " mm")
        if "closed_share" in facts:
            parts.append(f"{facts['closed_share']:.0%} of the surface closed where no photo shows it")
        if facts.get("watertight") is False:
            parts.append("not watertight")
        return f"{self.path} ({', '.join(parts)})" if parts else str(self.path)


@dataclass(frozen=True)
class Exported:
    """One object (or the background, or the whole scene) and its files.

    class_id: None for the whole scene. center: [3], the point of the world that is the files' origin. up: [3], the
    direction of the world that is the files' z. low, high: [3], its box, in the files' frame. to_run: 4 x 4 matrix from
    the files' frame to the run's normalised one. left_out: Gaussians of the object that do not belong to it; None if it
    was not cleaned. added: Gaussians that close it in its splat files; None if it was not closed.
    """

    name: str
    class_id: int | None
    gaussians: int
    center: list[float]
    up: list[float]
    low: list[float]
    high: list[float]
    to_run: list[list[float]]
    files: list[ExportedFile]
    left_out: LeftOut | None = None
    added: Added | None = None

    def __str__(self) -> str:
        """Return a line for users."""
        facts = [amount(self.gaussians, "Gaussian"), *(str(each) for each in (self.left_out, self.added) if each)]
        return f"{self.name}: {'; '.join(facts)}"

    def to_json(self, folder: Path) -> dict[str, Any]:
        """Return plain values for the manifest in ``folder``."""
        return {
            "name": self.name,
            "class_id": self.class_id,
            "gaussians": self.gaussians,
            **({} if self.left_out is None else {"left_out_gaussians": asdict(self.left_out)}),
            **({} if self.added is None else {"closing_gaussians": asdict(self.added)}),
            "center": self.center,
            "up": self.up,
            "box": {"low": self.low, "high": self.high},
            "to_run": self.to_run,
            "files": [
                {"format": file.format, "path": file.path.relative_to(folder).as_posix()}
                | {"bytes": file.path.stat().st_size, **file.facts}
                for file in self.files
                if file.path is not None
            ],
            "left_out": [{"format": file.format, "reason": file.reason} for file in self.files if file.path is None],
        }
