"""The nerfstudio model: a 2D-Gaussian-splatting scene with classes, trained by the losses its config lists."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes
from nerfstudio.models.base_model import Model
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.core.densification import initial_surfels
from beags_plugin.core.exposure import not_beyond_white
from beags_plugin.evaluation.run_metrics import psnr_after_fit
from beags_plugin.labels.class_ids import BACKGROUND
from beags_plugin.losses.base import LossInputs
from beags_plugin.losses.class_members import ClassMembers
from beags_plugin.losses.photometric import psnr, ssim
from beags_plugin.plugin.training.callbacks import training_callbacks
from beags_plugin.plugin.training.scene_model import LastRender, SceneModel
from beags_plugin.plugin.viewer.panel import ObjectPanel, ViewerLink
from beags_plugin.plugin.viewer.viewing import Viewing, called_by_viewer, scene_outputs
from beags_plugin.rasterizers.interface import RasterOutputs, SurfelInputs
from beags_plugin.rasterizers.rendering import fixed_background, surfel_inputs
from beags_plugin.views.cameras import camera_from_nerfstudio
from beags_plugin.views.objects_alone import of_objects, where_known


class BeagsModel(SceneModel):
    """Renders, scores and trains a scene by the losses of its config, as nerfstudio asks a model to."""

    def populate_modules(self) -> None:
        """Build the Gaussians from the seed points of the data."""
        Model.populate_modules(self)  # SplatfactoModel's would load weights and call .cuda().
        self.collider = None
        if self.seed_points is None:
            raise ValueError("the data supplies no seed points; use the data parser beags-data, which always does")
        generator = torch.Generator().manual_seed(torch.initial_seed() % 2**63)
        points, colors = (values.detach().cpu().float() for values in self.seed_points)
        metadata = self.kwargs.get("metadata") or {}
        classes = metadata.get("classes") or {BACKGROUND: "background"}
        self.hold(initial_surfels(points, colors / 255.0, self.config.sh_degree, generator), classes)
        self._members: ClassMembers | None = None
        self.viewing = Viewing(self)
        self.viewer_panel = ObjectPanel(self.viewing)  # Nerfstudio looks for both among the public attributes.
        self.viewer_link = ViewerLink(self.viewer_panel)

    def update_to_step(self, step: int) -> None:
        """Set the step to that of a checkpoint before it is loaded."""
        self.step = step

    # -- rendering ---------------------------------------------------------------------------------------------------

    def get_outputs(self, camera: Cameras) -> dict[str, Any]:
        """Render one view: for a training step, for the viewer, or the whole scene."""
        if self.training:
            return self._training_outputs(camera)
        with torch.no_grad():
            view = camera_from_nerfstudio(camera, 0).to(self.device)
            return self.viewing.outputs(view) if called_by_viewer() else scene_outputs(self, view)

    def _training_outputs(self, cameras: Cameras) -> dict[str, Any]:
        metadata = cameras.metadata or {}
        # The data manager's camera has its numbers on the host too.
        camera = metadata.get("camera") or camera_from_nerfstudio(cameras, 0).to(self.device)
        needs = frozenset().union(*(loss.needs for loss in self.active_losses().values()))
        labels = metadata.get("labels")
        against = labels if "boundary" in needs else None
        # Behind objects alone the colour is random, so that no Gaussian can learn it.
        background = self._training_background(random=metadata.get("objects_alone", False))
        class_ids = None if against is None else self.class_ids
        inputs = surfel_inputs(self.surfels(), camera, self.active_sh_degree(), class_ids)
        if self.growing:
            inputs = replace(inputs, screen_shift=torch.zeros_like(inputs.means[:, :2]).requires_grad_())
        if self.photo_colors is not None:
            inputs = replace(inputs, colors=self.photo_colors(inputs.colors, metadata["cam_idx"]))
        settings = self.settings(geometry="geometry" in needs, distortion="distortion" in needs)
        render = self.rasterizer.rasterize(inputs, camera, settings, background, against)
        self.last_render = LastRender(camera, render, inputs.screen_shift, labels, metadata.get("close_up", False))
        outputs = {"rgb": render.color, "accumulation": render.alpha[..., None], "background": background}
        if render.depth is not None:
            outputs["depth"] = render.depth[..., None]
        return outputs

    def _training_background(self, random: bool) -> Tensor:
        if random or self.config.background_color == "random":
            return to_device_async(torch.rand(3, generator=self.generator(self.step)), self.device)
        return fixed_background(self.config, self.device)

    def set_background(self, background_color: Tensor) -> None:
        """Set the background [3] of the viewer's pictures."""
        self.viewing.background = background_color

    # -- losses and metrics --------------------------------------------------------------------------------------------

    def _truth(self, batch: dict[str, Any], background: Tensor) -> Tensor:
        """Return the photograph [H, W, 3], with the background behind what is transparent."""
        image = self.get_gt_img(batch["image"])
        if "alpha" in batch:  # The image lies on black.
            image = image + (1.0 - self.get_gt_img(batch["alpha"])[..., None]) * background
        return image

    def get_gt_img(self, image: Tensor) -> Tensor:
        """Return the image [H, W, C] float in 0..1 on the model's device; never downscaled."""
        return (image.float() / 255.0 if image.dtype == torch.uint8 else image).to(self.device)

    def get_metrics_dict(self, outputs: dict[str, Any], batch: dict[str, Any]) -> dict[str, Any]:
        """Return the number of Gaussians and, in a step whose metrics are read, PSNR of the rendered view."""
        metrics: dict[str, Any] = {"gaussian_count": self.num_points}
        if self.measuring:
            with torch.no_grad():
                image = self._truth(batch, outputs["background"])
                metrics["psnr"] = psnr(where_known(outputs["rgb"], image, batch), image)
        return metrics

    def get_loss_dict(
        self, outputs: dict[str, Any], batch: dict[str, Any], metrics_dict: dict[str, Any] | None = None
    ) -> dict[str, Tensor]:
        """Return each active term by name, weighted."""
        image = self._truth(batch, outputs["background"])
        if not self.training or self.last_render is None:
            return {"photometric": (outputs["rgb"] - image).abs().mean()}
        render = of_objects(self.last_render.render, image, batch)
        if self.photo_colors is not None:
            render = replace(render, color=not_beyond_white(render.color, image))
        inputs = LossInputs(
            step=self.step,
            seed=self.seed,
            surfels=self.surfels(),
            camera=self.last_render.camera,
            render=render,
            image=image,
            labels=self.last_render.labels,
            class_ids=self.class_ids,
            grid=self.grid,
            screen_shift=self.last_render.screen_shift,
            draw=self._draw_apart,
            members=self._class_members(),
            present=batch.get("present"),
        )

        def base_terms() -> dict[str, Tensor]:
            return {name: loss.weighted(inputs) for name, loss in self.active_losses().items()}

        own, step = self.own_training, self.step - self.schedule.base_steps
        terms = base_terms() if own is None else own.terms(inputs, step, base_terms)
        # A frozen scene still needs a loss to call backward on; no parameter depends on this one.
        return terms or {"none": torch.zeros((), device=self.device, requires_grad=True)}

    def _draw_apart(self, inputs: SurfelInputs, camera: Camera) -> RasterOutputs:
        """Render Gaussians apart from the scene for a loss, with geometry, on black."""
        return self.rasterizer.rasterize(inputs, camera, self.settings(), inputs.means.new_zeros(3))

    def _class_members(self) -> ClassMembers:
        if self._members is None or not self._members.current(self.class_ids):
            self._members = ClassMembers(self.class_ids)
        return self._members

    def get_image_metrics_and_images(
        self, outputs: dict[str, Any], batch: dict[str, Any]
    ) -> tuple[dict[str, float], dict[str, Tensor]]:
        """Return PSNR and SSIM of an evaluation view, and pictures for tensorboard.

        If the scene has exposures, also ``psnr_fit``: PSNR after the affine colour fit of the view.
        """
        image = self._truth(batch, outputs["background"])
        metrics = {"psnr": float(psnr(outputs["rgb"], image)), "ssim": float(ssim(outputs["rgb"], image))}
        if self.exposures is not None:
            metrics["psnr_fit"] = psnr_after_fit(outputs["rgb"], image)
        images = {"img": torch.cat([image, outputs["rgb"]], dim=1)}
        if "class_map" in outputs:
            images["class_map"] = outputs["class_map"]
        return metrics, images

    def get_training_callbacks(
        self, training_callback_attributes: TrainingCallbackAttributes
    ) -> list[TrainingCallback]:
        """Return the callbacks of ``plugin.training.callbacks``."""
        return training_callbacks(self, training_callback_attributes)


def to_device_async(value: Tensor, device: torch.device) -> Tensor:
    """Copy ``value`` from the CPU to ``device``; the host does not wait until it is there."""
    if device.type != "cuda":
        return value.to(device)
    return value.pin_memory().to(device, non_blocking=True)  # The host waits for copies of memory that is not pinned.
