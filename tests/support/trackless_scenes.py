"""Samples whose data do not say which photos show their points, or have none."""

from __future__ import annotations

import json
from pathlib import Path

from beags_plugin.sample.writer import SampleConfig, write_sample

SMALL = SampleConfig(width=56, height=42, num_train=8, num_test=2, num_points=600)


def written(at: Path, config: SampleConfig, points: bool = False) -> Path:
    """Write a sample without tracks. points: with its seed points."""
    write_sample(at / "data", config)
    (at / "data/seed_tracks.json").unlink()
    if not points:
        file = at / "data/transforms.json"
        file.write_text(json.dumps({k: v for k, v in json.loads(file.read_text()).items() if k != "ply_file_path"}))
        (at / "data/seed_points.ply").unlink()
    return at / "data"
