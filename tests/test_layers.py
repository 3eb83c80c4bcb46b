"""Imports go one way: the maths knows nothing of nerfstudio, and the plugin's own import stays light."""

from __future__ import annotations

import subprocess
import sys

import pytest

LAYOUTS = ["colmap", "dtu", "lerf_mask", "llff", "mipnerf360", "nerfstudio", "spin_nerf", "three_d_ovs"]
CORE = [  # all that stands under the plugin layer
    "core.surfels",
    "core.densification",
    "rasterizers.torch_reference",
    "rasterizers.native",
    "losses.occupancy",
    "losses.photometric",
    "losses.normal",
    "masks.reprojection",
    "masks.voxel_reprojection",
    "masks.check.areas",
    "masks.check.disagreement",
    "masks.check.files",
    "masks.pictures",
    "masks.rims",
    *(f"masks.sources.{name}" for name in ("coco", "grabcut", "id_images", "langsplat", "object_images", "sam2")),
    "ops.occupancy_loss",
    "assignment.assignment",
    "occupancy.build",
    "refiners.bea",
    "refiners.preparation",
    "extraction.ply",
    "export.base",
    "export.frames",
    "export.mesh",
    "export.splats",
    "export.spz",
    "importers.ply",
    "importers.checkpoint",
    "turntable.orbit",
    "turntable.pictures",
    "turntable.video",
    "evaluation.run_metrics",
    "evaluation.contact_sheet",
    "evaluation.report",
    "evaluation.table",
    "evaluation.worst_views",
    "viewing.choice",
    "viewing.legend",
    "viewing.picking",
    "viewing.pictures",
    "occupancy.violation",
    "sample.writer",
    "data.labels",
    "data.ground_truth",
    "data.split",
    *(f"data.layouts.{name}" for name in LAYOUTS),
    "cli",
]


def loaded_by(statement: str) -> set[str]:
    code = f"import sys\n{statement}\nprint(*sorted(name for name in sys.modules))"
    return set(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split())


def test_nothing_under_the_plugin_layer_imports_nerfstudio():
    modules = loaded_by("; ".join(f"import beags_plugin.{name}" for name in CORE))
    assert not {name for name in modules if name.split(".")[0] == "nerfstudio"}


def test_the_plugin_adds_nothing_heavy_to_a_nerfstudio_command():
    """What ns-* commands load anyway is free; the rest must be modules of ours and a few small ones."""
    pytest.importorskip("nerfstudio")
    before = loaded_by("import nerfstudio.configs.method_configs")
    assert "beags_plugin.plugin.methods" in before, "the entry points of this package are not installed"
    assert not before & {"open3d", "beags_plugin.sample.writer", "beags_plugin.evaluation.run_metrics"}


def test_the_package_itself_imports_nothing():
    assert not loaded_by("import beags_plugin") & {"torch", "numpy", "nerfstudio"}
