"""A scene as refiners that own their training get it: discs of three classes, seen from a ring of cameras."""

from __future__ import annotations

from contextlib import nullcontext

import torch
from data_folders import CX, CY, FX, FY, HEIGHT, WIDTH, ring
from run_folders import discs

from beags_plugin.core.cameras import Camera, viewmat_from_opengl
from beags_plugin.core.surfels import Surfels
from beags_plugin.labels.class_ids import BACKGROUND
from beags_plugin.losses.base import LossInputs
from beags_plugin.preparation.refiner_training import TrainedScene
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.rasterizers.interface import RasterSettings
from beags_plugin.rasterizers.rendering import render_class_map, surfel_inputs

FAR_APART = (0, 7, 40_000)  # ids of the background and both objects
FACTOR = 3  # divisor of the pictures' size


def trained_scene(ids: tuple[int, ...] = FAR_APART, steps: int = 3_000, scale: float = 1.0) -> TrainedScene:
    """Return the discs with gradients, and one more behind all cameras; each view's mask is what it sees."""
    visible, ranks = discs()
    surfels = Surfels(*(torch.cat([values, values[:1]]) for values in vars(visible).values()))
    surfels.means[-1] = torch.tensor([0.0, 0.0, 50.0])
    class_ids = torch.tensor(ids, dtype=torch.int32)[torch.cat([ranks, ranks[:1]]).long()]
    for values in vars(surfels).values():
        values.requires_grad_()
    rasterizer, settings = make_rasterizer("auto"), RasterSettings(0.03, 300.0, geometry=False)
    K = torch.tensor([[FX, 0, CX], [0, FY, CY], [0, 0, 1 / FACTOR]]) * FACTOR
    viewmats = [viewmat_from_opengl(torch.from_numpy(pose)).float() for pose in ring(9)]
    cameras = [Camera(viewmat, K, FACTOR * WIDTH, FACTOR * HEIGHT) for viewmat in viewmats]
    labels = []
    for camera in cameras:
        found, _ = render_class_map(rasterizer, surfels.detach(), class_ids, camera, settings)
        labels.append(torch.where(found > max(ids), BACKGROUND, found))  # nothing drawn
    return TrainedScene(
        surfels=lambda: surfels,
        class_ids=lambda: class_ids,
        cameras=cameras,
        labels=labels,
        names={class_id: f"class_{class_id}" for class_id in ids},
        rasterizer=rasterizer,
        settings=settings,
        seed=0,
        steps=steps,
        base_steps=100,
        extent=3.0,
        scale=scale,
        stage=lambda title: nullcontext(lambda done, total: None),
    )


def loss_inputs(scene: TrainedScene, view: int = 0, masked: bool = True) -> LossInputs:
    """Return what a step on a view gives the losses."""
    surfels, camera = scene.surfels(), scene.cameras[view]
    render = scene.rasterizer.rasterize(surfel_inputs(surfels, camera), camera, scene.settings, torch.zeros(3))
    labels = scene.labels[view] if masked else None
    return LossInputs(0, 0, surfels, camera, render, torch.zeros_like(render.color), labels, scene.class_ids())
