"""``beags sample``: a generated scene with exact ground truth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from beags_plugin.commands.answers import CONSOLE
from beags_plugin.commands.starting import starting
from beags_plugin.system.output_option import OUTPUT

if TYPE_CHECKING:
    from beags_plugin.sample.writer import SampleConfig


@dataclass
class Sample:
    """Generate a scene with exact ground truth: photos, damaged masks, silhouettes, depth, objects removed."""

    output: Annotated[Path, OUTPUT] = Path("outputs/sample")
    """Folder to write."""
    seed: int = 0
    """Another seed gives another arrangement."""
    width: int = 256
    """Pixels."""
    height: int = 192
    """Pixels."""
    degradation: str = "mild"
    """How masks are damaged: none, mild or strong."""
    views: int = 60
    """Views to train on; 12 more are held out."""
    family: str = "tabletop"
    """tabletop: plain solids that touch. desk: textured objects that touch in a furnished room. Both are seen from all
    sides. benchmarks/ adds turntable (the tabletop's solids turn while the room stands still) and room (textured
    objects that lean on and stand in one another, seen from one side)."""

    def config(self) -> SampleConfig:
        """Return the config of the sample to write."""
        from beags_plugin.sample.writer import SampleConfig

        return SampleConfig(
            self.seed, self.width, self.height, self.views, degradation=self.degradation, family=self.family
        )

    def run(self) -> None:
        with starting(self):
            from beags_plugin.sample.writer import make_sample

            config = self.config()
        make_sample(self.output, config)
        CONSOLE.print(f"sample: {self.output}")
