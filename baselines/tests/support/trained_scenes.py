"""A scene as refiners that own their training get it: discs of three classes, seen from a ring of cameras."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import nullcontext
from dataclasses import replace

import torch
from data_folders import CX, CY, FX, FY, HEIGHT, WIDTH, ring
from run_folders import discs

from beags_plugin.core.cameras import Camera, viewmat_from_opengl
from beags_plugin.core.surfels import Surfels
from beags_plugin.labels.class_ids import BACKGROUND
from beags_plugin.losses.base import LossInputs
from beags_plugin.preparation.refiner_training import OwnTraining, TrainedScene
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


def stepped(own: OwnTraining, steps: Iterable[int], masked: bool = True, drawn: bool = True, geometry: bool = False):
    """Make steps without the terms of the base.

    masked: whether views have masks. drawn: whether the training gets a rendering, which some trainings do not read.
    geometry: whether the Gaussians learn from its terms too.
    """
    scene = own.scene
    adam = torch.optim.Adam(list(vars(scene.surfels()).values()) if geometry else [torch.zeros(())], lr=0.005)
    for step in steps:
        own.before_step(step)
        adam.zero_grad()
        inputs = loss_inputs(scene, step % len(scene.cameras), masked) if drawn else None
        if terms := own.terms(inputs, step, dict):  # pyright: ignore[reportArgumentType]
            torch.stack(list(terms.values())).sum().backward()
            adam.step()
        own.after_step(step)


def crowded(scene: TrainedScene) -> TrainedScene:
    """Return a scene with Gaussians enough for several threads to share."""
    many = Surfels(*(each.repeat(60, *[1] * (each.dim() - 1)) for each in vars(scene.surfels().detach()).values()))
    many.means[:] += 0.3 * torch.randn(many.means.shape, generator=torch.Generator().manual_seed(1))
    return replace(scene, surfels=lambda: many, class_ids=lambda: torch.zeros(len(many), dtype=torch.int32))
