"""Parts that the tests of ``beags bench`` share."""

from __future__ import annotations

from pathlib import Path

from beags_benchmarks.experiments.scenes import TrialScene

GOOD = """
description = "d"
preset = "beags-tiny"
reference = "none"
[both]
"pipeline.model.sh_degree" = 0
[refine]
"pipeline.model.refine_steps" = 7
[[variant]]
name = "none"
[variant.refine]
"pipeline.model.refiner" = "none"
"pipeline.model.refine_steps" = 1
[[variant]]
name = "noisy"
[variant.base]
"pipeline.model.losses.normal.weight" = 0.0
[[sweep]]
name = "k"
key = "pipeline.model.prepare.k"
values = [5, 10]
relative_to_pixels = true
[sweep.lines.plain]
[sweep.lines."no R"]
"pipeline.model.prepare.reprojection" = "none"
[[sweep]]
name = "damage"
key = "damage"
values = [0.0, 1.5]
"""


def written(folder: Path, text: str) -> str:
    path = folder / "mine.toml"
    path.write_text(text)
    return str(path)


def scene(name: str = "a", digest: str = "1") -> TrialScene:
    return TrialScene(name, Path("/nowhere"), 1.0, digest)


def masks_of(*scenes: TrialScene) -> dict[tuple[str, str], Path]:
    return {(s.name, f"damage = {degree}"): Path(f"masks-{s.name}-{degree}") for s in scenes for degree in ("0", "1.5")}
