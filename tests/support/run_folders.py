"""Runs on disk without training: a few discs in front of the ring of cameras of ``data_folders``."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import torch
from data_folders import CX, CY, FX, FY, HEIGHT, WIDTH, ring, write_image, write_transforms

from beags_plugin.core.cameras import Camera, viewmat_from_opengl
from beags_plugin.core.surfels import Surfels
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.rasterizers.interface import RasterSettings
from beags_plugin.rasterizers.rendering import render_class_map, surfel_inputs

CLASSES = {0: "background", 1: "cup", 2: "box"}
SETTINGS = RasterSettings(0.03, 300.0)


def discs(seed: int = 0, shift: float = 0.0) -> tuple[Surfels, torch.Tensor]:
    """Return two clouds of opaque discs, cup and box, and a few of the background; classes [N] int32."""
    generator = torch.Generator().manual_seed(seed)
    centers = {1: (-0.5 + shift, 0.0, 0.1), 2: (0.5, 0.1, 0.0), 0: (0.0, 0.0, -0.7)}
    means, ids = [], []
    for class_id, center in centers.items():
        means.append(0.12 * torch.randn(25, 3, generator=generator) + torch.tensor(center))
        ids += [class_id] * 25
    count = len(ids)
    surfels = Surfels.of(
        torch.cat(means),
        torch.randn(count, 4, generator=generator),
        torch.full((count, 2), -2.0),
        torch.full((count,), 3.0),
        0.5 * torch.randn(count, 4, 3, generator=generator),
    )
    return surfels, torch.tensor(ids, dtype=torch.int32)


def write_scene(root: Path, masks: bool = True, truth_factor: int = 1) -> Path:
    """Write nine views with id masks of two rectangles; ``truth_factor`` > 1 enlarges the ground truth."""
    write_transforms(root)
    (root / "classes.json").write_text(json.dumps({str(index): name for index, name in CLASSES.items() if index}))
    ids = np.zeros((HEIGHT, WIDTH), np.uint8)
    ids[4:9, 4:9], ids[4:8, 11:15] = 1, 2
    for index in range(9) if masks else ():
        write_image(root / f"masks/v{index:02d}.png", np.roll(ids, index % 3, axis=1))
    if masks and truth_factor > 1:
        large = np.kron(ids, np.ones((truth_factor, truth_factor), np.uint8))
        for name in ("v00", "v08"):
            write_image(root / f"ground_truth/masks/{name}.png", large)
            write_image(root / f"ground_truth/silhouettes/cup/{name}.png", np.uint8(255) * (large == 1))
    return root


def write_drawn_scene(root: Path, factor: int = 4) -> Surfels:
    """Write nine fitting photos and masks of the discs, ``factor`` times as large as other scenes; return the discs."""
    surfels, _ = discs()
    rasterizer = make_rasterizer("auto")
    write_scene(root)
    meta = json.loads((root / "transforms.json").read_text())
    meta |= {name: factor * meta[name] for name in ("fl_x", "fl_y", "cx", "cy", "w", "h")}
    (root / "transforms.json").write_text(json.dumps(meta))
    for index, camera in enumerate(ring_cameras(9, factor)):
        image = rasterizer.rasterize(surfel_inputs(surfels, camera), camera, SETTINGS, torch.zeros(3)).color
        write_image(root / f"images/v{index:02d}.png", (255 * image.clamp(0, 1)).round().to(torch.uint8).numpy())
        write_image(root / f"masks/v{index:02d}.png", drawn_labels(camera).to(torch.uint8).numpy())
    return surfels


def ring_cameras(count: int, factor: int) -> list[Camera]:
    """Return cameras around the discs, ``factor`` times as large as those of ``data_folders``."""
    K = torch.tensor([[FX, 0, CX], [0, FY, CY], [0, 0, 1 / factor]]) * factor
    viewmats = (viewmat_from_opengl(torch.from_numpy(pose)).float() for pose in ring(count))
    return [Camera(viewmat, K, factor * WIDTH, factor * HEIGHT) for viewmat in viewmats]


def drawn_labels(camera: Camera) -> torch.Tensor:
    """Return the class map of the discs, 0 where nothing is drawn."""
    labels, _ = render_class_map(make_rasterizer("auto"), *discs(), camera, SETTINGS)
    return labels.masked_fill_(labels > max(CLASSES), 0)


def write_trained(
    folder: Path, data: Path, assigned: bool = True, base: bool = True, background: str = "black", scale: float = 1.0
) -> Path:
    """Write a run of ``discs``, with its base if asked for; return config.yml. Before refinement the cup is off.

    scale: of the world, with its cameras.
    """
    from beags_plugin.plugin.options.config import base_config
    from beags_plugin.runs.write import write_run

    config = base_config()
    config.run_dir = folder
    parser = config.data_config.dataparser
    parser.data, parser.orientation_method, parser.center_method = data, "none", "none"
    parser.auto_scale_poses, parser.scale_factor = False, scale
    config.model_config.background_color = background
    if assigned and base:
        write_run(config, folder / "base", state_of(*discs(shift=0.15), scale=scale), 99)
    return write_run(config, folder, state_of(*discs(), assigned=assigned, scale=scale), 199)


def rename_classes(config_path: Path, classes: dict[int, str]) -> None:
    """Give a run's classes other names, and more of them, which then have no Gaussians."""
    from beags_plugin.runs.relocation import open_run
    from beags_plugin.runs.write import write_run

    state = state_of(*discs()) | {"_extra_state": {"classes": classes}}
    write_run(open_run(config_path), config_path.parent, state, 299)


def write_camera_path(path: Path) -> Path:
    """Write a file such as the viewer's tab Render saves: five cameras of the ring."""
    cameras = [{"camera_to_world": pose.flatten().tolist(), "fov": 40.0, "aspect": 4 / 3} for pose in ring(5)]
    content = {"camera_type": "perspective", "render_height": 96, "render_width": 128, "fps": 12, "seconds": 0.4}
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps({**content, "keyframes": [], "is_cycle": False, "camera_path": cameras}))
    return path


def state_of(surfels: Surfels, class_ids: torch.Tensor, assigned: bool = True, scale: float = 1.0) -> dict:
    return {
        "gauss_params.means": scale * surfels.means,
        "gauss_params.quats": surfels.quats,
        "gauss_params.scales": surfels.log_scales + math.log(scale),
        "gauss_params.opacities": surfels.opacity_logits[:, None],
        "gauss_params.features_dc": surfels.sh_dc,
        "gauss_params.features_rest": surfels.sh_rest,
        "class_ids": class_ids,
        "class_margin": torch.ones(len(class_ids)),
        "assigned": torch.tensor(assigned),
        "extent": torch.tensor(3.0 * scale),
        "refined_steps": torch.tensor(0),
        "_extra_state": {"classes": CLASSES if assigned else {0: "background"}},
    }


def write_prepared(run: Path, shift: int = 0, scale: float = 1.0) -> None:
    """Write masks after reprojection, and a grid in which all left of the middle is valid for the cup.

    Masks are those of the data moved down by ``shift`` rows. scale: of the world.
    """
    from beags_plugin.labels.classes import write_mask
    from beags_plugin.occupancy.grid import VisibilityGrid

    folder = run / "prepared"
    (folder / "masks").mkdir(parents=True)
    ids = np.zeros((12, 20), np.uint8)
    ids[4:9, 4:9], ids[4:8, 11:15] = 1, 2
    for index in range(9):
        write_mask(folder / f"masks/v{index:02d}.png", np.roll(np.roll(ids, index % 3, axis=1), shift, axis=0))
    points = torch.cartesian_prod(*(torch.arange(-2.0, 2.0, 0.25) for _ in range(3)))
    cup = points[points[:, 0] < -0.75]  # valid is one voxel more
    grid = VisibilityGrid.from_points(
        [(scale * cup, torch.ones(len(cup), dtype=torch.int64))], 0.25 * scale, torch.zeros(3, dtype=torch.float64), 3
    )
    torch.save(grid.state_dict(), folder / "grid.pt")
