"""A run of the touching solids on disk: what a user opens to pick objects in, or exports objects from."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import torch
from data_folders import write_image
from touching_solids import SETTINGS, solids, views

from beags_plugin.core.cameras import Camera
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.rasterizers.rendering import render_class_map, surfel_inputs

COLOURED = {0: (0.6, 0.6, 0.6), 1: (0.8, 0.2, 0.2), 2: (0.2, 0.3, 0.8)}
POINTS = {"low": (-0.2, 0.0, 0.25), "high": (0.15, 0.0, 0.5), "floor": (-0.7, 0.3, 0.0)}


def solid_cameras() -> list[Camera]:
    """Return the cameras of the photos v0, v1, ...; the first of them sees both blocks."""
    return views()[3:] + views()[:3]


def write_solids(root: Path, colors: dict[int, tuple[float, float, float]] = COLOURED) -> Path:
    """Write the scene's photos and poses, without masks; return its folder. colors: of the solids in the photos."""
    surfels, _ = solids(colors)
    rasterizer, frames = make_rasterizer("auto"), []
    cameras = solid_cameras()
    for index, camera in enumerate(cameras):
        image = rasterizer.rasterize(surfel_inputs(surfels, camera), camera, SETTINGS, torch.zeros(3)).color
        write_image(root / f"images/v{index}.png", (255 * image.clamp(0, 1)).round().to(torch.uint8).numpy())
        pose = torch.linalg.inv(camera.viewmat.double()).numpy() @ np.diag([1.0, -1.0, -1.0, 1.0])
        frames.append({"file_path": f"images/v{index}.png", "transform_matrix": pose.tolist()})
    K = cameras[0].K
    intrinsics = {"fl_x": float(K[0, 0]), "fl_y": float(K[1, 1]), "cx": float(K[0, 2]), "cy": float(K[1, 2])}
    size = {"w": cameras[0].width, "h": cameras[0].height, "camera_model": "OPENCV"}
    (root / "transforms.json").write_text(json.dumps({**intrinsics, **size, "frames": frames}))
    return root


def write_kept_masks(run: Path) -> None:
    """Write what a run keeps of exact masks of the solids."""
    from beags_plugin.labels.classes import write_mask

    surfels, owner = solids(COLOURED)
    (run / "prepared/masks").mkdir(parents=True)
    for index, camera in enumerate(solid_cameras()):
        labels, _ = render_class_map(make_rasterizer("auto"), surfels, owner.int(), camera, SETTINGS)
        write_mask(run / f"prepared/masks/v{index}.png", np.where(labels.numpy() > 2, IGNORE, labels.numpy()))
    torch.save({}, run / "prepared/grid.pt")


def write_solids_run(
    folder: Path, data: Path, assigned: bool = False, spilled: bool = True
) -> tuple[Path, torch.Tensor]:
    """Write a run of the solids in the frame of their poses; return config.yml and whose each Gaussian is, [N] int64.

    assigned: as a run whose classes are the solids; spilled: but the low one has the floor about it too.
    """
    from beags_plugin.plugin.options.config import base_config
    from beags_plugin.runs.write import write_run

    config = base_config()
    config.run_dir = folder
    parser = config.data_config.dataparser
    parser.data, parser.orientation_method, parser.center_method = data, "none", "none"
    parser.auto_scale_poses, parser.scale_factor = False, 1.0
    config.model_config.background_color = "black"
    surfels, owner = solids(COLOURED)
    over = (owner == 0) & (surfels.means[:, 0] < -0.3) & spilled
    given = torch.where(over, 1, owner).int() if assigned else owner.int() * 0
    state = {
        "gauss_params.means": surfels.means, "gauss_params.quats": surfels.quats,
        "gauss_params.scales": surfels.log_scales, "gauss_params.opacities": surfels.opacity_logits[:, None],
        "gauss_params.features_dc": surfels.sh_dc, "gauss_params.features_rest": surfels.sh_rest,
        "class_ids": given, "class_margin": torch.ones(len(given)), "assigned": torch.tensor(assigned),
        "extent": torch.tensor(2.5), "refined_steps": torch.tensor(0),
        "_extra_state": {"classes": {0: "background", 1: "low", 2: "high"} if assigned else {0: "background"}},
    }  # fmt: skip
    return write_run(config, folder, state, 99), owner
