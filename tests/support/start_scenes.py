"""Scenes to start from: discs before turned and shifted cameras, photos of them, and files that hold them."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import torch
from data_folders import CX, CY, FX, FY, HEIGHT, WIDTH, ring, write_image, write_transforms
from run_folders import discs

from beags_plugin.core.cameras import Camera, viewmat_from_opengl
from beags_plugin.core.rotations import rotation_from_quat
from beags_plugin.core.surfels import Surfels
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.rasterizers.interface import RasterSettings
from beags_plugin.rasterizers.rendering import surfel_inputs
from beags_plugin.splat_io.frames import from_input_frame


@dataclass(frozen=True)
class StartScene:
    """root: the data. surfels: the discs in the world of its poses."""

    root: Path
    surfels: Surfels


def a_frame(seed: int, scale: float = 1.0) -> tuple[torch.Tensor, float]:
    """Return some rotation and shift [3, 4] float64, and the scale."""
    generator = torch.Generator().manual_seed(seed)
    rotation = rotation_from_quat(torch.randn(4, generator=generator, dtype=torch.float64))
    return torch.cat([rotation, torch.randn(3, 1, generator=generator, dtype=torch.float64)], dim=1), scale


def in_frame(surfels: Surfels, frame: tuple[torch.Tensor, float]) -> Surfels:
    """Return surfels of the world in x' = scale (R x + t), by way of float64."""
    exact = Surfels(**{field.name: getattr(surfels, field.name).double() for field in fields(surfels)})
    moved = from_input_frame(exact, *frame)
    return Surfels(**{field.name: getattr(moved, field.name).float() for field in fields(moved)})


def write_start_scene(root: Path) -> StartScene:
    """Write nine photos of ``run_folders``' discs and masks of two rectangles; the world is turned and shifted."""
    transform, _ = a_frame(5)
    turn = np.eye(4)
    turn[:3] = transform.numpy()
    poses = [turn @ pose for pose in ring(9)]
    write_transforms(root, poses=poses)
    surfels = in_frame(discs()[0], (transform, 1.0))
    K = torch.tensor([[FX, 0.0, CX], [0.0, FY, CY], [0.0, 0.0, 1.0]])
    ids = np.zeros((HEIGHT, WIDTH), np.uint8)
    ids[4:9, 4:9], ids[4:8, 11:15] = 1, 2
    for index, pose in enumerate(poses):
        camera = Camera(viewmat_from_opengl(torch.from_numpy(pose)).float(), K, WIDTH, HEIGHT)
        image = drawn(surfels, camera, RasterSettings(0.03, 300.0))
        write_image(root / f"images/v{index:02d}.png", (255 * image.clamp(0, 1)).round().to(torch.uint8).numpy())
        write_image(root / f"masks/v{index:02d}.png", np.roll(ids, index % 3, axis=1))
    return StartScene(root, surfels)


def drawn(surfels: Surfels, camera: Camera, settings: RasterSettings) -> torch.Tensor:
    """Render [H, W, 3] on black."""
    with torch.no_grad():
        render = make_rasterizer("auto").rasterize(surfel_inputs(surfels, camera), camera, settings, torch.zeros(3))
    return render.color


def with_volume(surfels: Surfels, thickness: float = 1e-3, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Return (log_scales [N, 3], quats [N, 4]) of the same discs with a thin third axis, which is any of the three."""
    from beags_plugin.splat_io.frames import quat_from_rotation

    rotations = rotation_from_quat(surfels.quats.double())
    thin = surfels.log_scales.amin(dim=1, keepdim=True) + float(np.log(thickness))
    scales = torch.cat([surfels.log_scales, thin], dim=1)
    orders = [(0, 1, 2), (2, 0, 1), (1, 2, 0), (1, 0, 2)]  # places of the axes u, v, n; the last is a mirror
    chosen = np.random.default_rng(seed).integers(len(orders), size=len(surfels))
    quats, log_scales = [], []
    for index, choice in enumerate(chosen):
        order = list(orders[choice])
        axes = rotations[index][:, order]
        axes = axes * torch.linalg.det(axes)  # a Gaussian is the same with an axis reversed
        quats.append(quat_from_rotation(axes))
        log_scales.append(scales[index, order])
    return torch.stack(log_scales).float(), torch.stack(quats).float()


def write_splatfacto(run: Path, surfels: Surfels, frame: tuple[torch.Tensor, float] | None, step: int = 29) -> Path:
    """Write a checkpoint as splatfacto does, of discs that lie in ``frame``; return the run's folder."""
    import json

    log_scales, quats = with_volume(surfels)
    state = {
        "means": surfels.means,
        "scales": log_scales,
        "quats": quats,
        "opacities": surfels.opacity_logits[:, None],
        "features_dc": surfels.sh_dc,
        "features_rest": surfels.sh_rest,
    }
    content = {
        "step": step,
        "pipeline": {f"_model.gauss_params.{name}": value for name, value in state.items()},
        "optimizers": {"means": {"state": {}, "param_groups": [{"lr": np.float64(1.6e-4)}]}},  # nerfstudio has the same
        "schedulers": {},
        "scalers": {},
    }
    (run / "nerfstudio_models").mkdir(parents=True)
    torch.save(content, run / "nerfstudio_models" / f"step-{step:09d}.ckpt")
    if frame is not None:
        written = {"transform": frame[0].tolist(), "scale": frame[1]}
        (run / "dataparser_transforms.json").write_text(json.dumps(written))
    return run
