"""The nerfstudio model: a 2D-Gaussian-splatting scene with classes, trained by the losses its config lists."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes
from nerfstudio.models.base_model import Model, ModelConfig
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.core.densification import DensifyConfig, initial_surfels
from beags_plugin.core.devices import sent
from beags_plugin.core.sh import MAX_DEGREE
from beags_plugin.errors import UserError
from beags_plugin.losses.base import Loss, LossInputs
from beags_plugin.losses.class_members import ClassMembers
from beags_plugin.losses.photometric import ssim
from beags_plugin.occupancy.grid import VisibilityGrid
from beags_plugin.plugin.cameras import camera_from_nerfstudio
from beags_plugin.plugin.loss_spec import LossSpec
from beags_plugin.plugin.schedule import PhaseSchedule
from beags_plugin.plugin.step_clock import StepClock
from beags_plugin.plugin.surfel_model import SurfelModel
from beags_plugin.plugin.training import training_callbacks
from beags_plugin.plugin.viewer_controls import ObjectPanel, ViewerLink
from beags_plugin.plugin.viewing import Viewing, asked_by_viewer, scene_outputs
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.rasterizers.drawing import surfel_inputs
from beags_plugin.rasterizers.interface import Rasterizer, RasterOutputs, RasterSettings, SurfelInputs
from beags_plugin.refiners.border_split import BorderSplitConfig
from beags_plugin.refiners.preparation import PreparationConfig


@dataclass
class BeagsModelConfig(ModelConfig):
    """Options of the scene and of its two training phases."""

    _target: type = field(default_factory=lambda: BeagsModel)
    rasterizer: str = "auto"
    """Backend: auto, native, torch, cuda (docs/cuda.md), or one that another package registers."""
    sh_degree: int = 3
    """Highest degree of the colour's spherical harmonics (0..3)."""
    sh_degree_interval: int = 1000
    """A degree is added every so many steps."""
    background_color: Literal["black", "white", "random"] = "black"
    """Background behind the scene, and behind images with alpha; "random" draws one per training step, and is black
    elsewhere."""
    start_from: Path | None = None
    """A trained scene to start from instead of seed points: a 3DGS or 2DGS .ply, or a run of splatfacto or beags. 3D
    Gaussians are flattened. base_steps then polish it, without growth."""
    start_format: str = "auto"
    """What start_from is: ply, checkpoint, or an importer of your own; auto recognises it."""
    start_frame: Literal["auto", "world", "normalised"] = "auto"
    """Frame of start_from: world, that of the input poses; normalised, that of this run; auto: world for a .ply, and
    for a run what its dataparser_transforms.json says."""
    base_steps: int = 30_000
    """Steps of base training; 0 for a refinement that starts from a loaded base."""
    refine_steps: int = 3_000
    """Steps of refinement; 0 trains a base only."""
    refine_rounds: int = 1
    """How often masks, classes and voxel grids are made, at even distances of refinement: each round starts again from
    the masks of the data, with the depth of the scene as it then is. 1, as in the paper: before refinement alone."""
    schedule_steps: int = 30_000
    """Length of base training for which all other steps and intervals of the base are stated; with another base_steps
    they are scaled in proportion. 0: they are taken as they are."""
    refiner: str = "bea"
    """What happens after class assignment: bea (this method), none (assignment alone), or a registered one."""
    losses: dict[str, LossSpec] = field(default_factory=dict)
    """The terms of the training loss by name."""
    densify: DensifyConfig = field(default_factory=DensifyConfig)
    """When and how the base grows and prunes its Gaussians."""
    prepare: PreparationConfig = field(default_factory=PreparationConfig)
    """Options of mask reprojection and of the voxel grids."""
    split: BorderSplitConfig = field(default_factory=BorderSplitConfig)
    """Which Gaussians at class borders are split before refinement; none unless rounds is 1 or more."""
    position_lr: tuple[float, float] = (1.6e-4, 1.6e-6)
    """First and last learning rate of the positions, log-linear, times the scene's extent."""
    base_lr_power: float = 0.0
    """All learning rates are stated for a base of 30,000 steps. A shorter one starts with (30,000 / base_steps) to this
    power times as much, and comes down to the stated by its end; 0: no more than stated."""
    refine_position_lr_factor: float = 1.0
    """Factor of the positions' learning rate while refining; 1, as in the paper, is the end of the base schedule."""
    refine_shape_lr_factor: float = 1.0
    """The same of scales and rotations."""
    near: float = 0.01
    """Near plane in units of the scene's extent."""
    far: float = 100.0
    """Far plane in units of the scene's extent."""

    def check(self) -> None:
        """Raise ``UserError`` for a value that training could not work with, or would only end with."""
        for name in ("base_steps", "refine_steps", "schedule_steps"):
            if (steps := getattr(self, name)) < 0:
                raise UserError(f"{name} is {steps}: give a number of steps, 0 or more.")
        if not 0 <= self.sh_degree <= MAX_DEGREE:
            raise UserError(f"sh_degree is {self.sh_degree}: choose 0 to {MAX_DEGREE}.")
        for name, value in (("sh_degree_interval", self.sh_degree_interval), ("densify.every", self.densify.every)):
            if value < 1:
                raise UserError(f"{name} is {value}: give a number of steps, 1 or more.")
        if not 0 < self.near < self.far < math.inf:
            raise UserError(f"near is {self.near} and far {self.far}: near must lie above 0 and below far.")
        if not all(0 < rate < math.inf for rate in self.position_lr):
            raise UserError(f"position_lr is {self.position_lr}: give two learning rates above 0.")
        for name in ("base_lr_power", "refine_position_lr_factor", "refine_shape_lr_factor"):
            if not 0 <= (value := getattr(self, name)) < math.inf:
                raise UserError(f"{name} is {value}: give 0 or more.")

    def schedule(self) -> PhaseSchedule:
        """Steps of both phases."""
        return PhaseSchedule(self.base_steps, self.refine_steps, self.schedule_steps, self.start_from is not None)


@dataclass(frozen=True)
class Drawn:
    """What the last training step drew.

    screen_shift: [N, 2] of ``SurfelInputs``, whose gradient growth looks at. labels: [H, W] int32 M', against which the
    boundary was drawn; None if it was not.
    """

    camera: Camera
    render: RasterOutputs
    screen_shift: Tensor | None
    labels: Tensor | None = None


def fixed_background(config: BeagsModelConfig, device: torch.device | str = "cpu") -> Tensor:
    """[3], the colour behind a scene that is looked at or scored: the one that it was trained on, black for random."""
    return torch.full((3,), 1.0 if config.background_color == "white" else 0.0, device=device)


class BeagsModel(SurfelModel):
    """A scene of surfels with classes that is drawn, scored and trained by the losses of its config."""

    config: BeagsModelConfig
    # buffers, for type checkers
    assigned: Tensor  # [] bool
    extent: Tensor  # [] float32, world units
    refined_steps: Tensor  # [] int64, refinement steps that the scene has been through

    def populate_modules(self) -> None:
        """Build the surfels from the seed points that the data supplies."""
        Model.populate_modules(self)  # not SplatfactoModel's: that one loads weights and calls .cuda()
        self.collider = None
        if self.seed_points is None:
            raise ValueError("the data supplies no seed points; use the data parser beags-data, which always does")
        generator = torch.Generator().manual_seed(torch.initial_seed() % 2**63)
        points, colors = (values.detach().cpu().float() for values in self.seed_points)
        self.hold(initial_surfels(points, colors / 255.0, self.config.sh_degree, generator))
        self.register_buffer("assigned", torch.tensor(False))
        self.register_buffer("extent", torch.tensor(1.0))
        self.register_buffer("refined_steps", torch.tensor(0))
        metadata = self.kwargs.get("metadata") or {}
        self.classes: dict[int, str] = dict(metadata.get("classes") or {0: "background"})
        self.schedule = self.config.schedule()
        self.losses = {
            name: spec.build(name, self.schedule)
            for name, spec in self.config.losses.items()
            if spec.weight != 0.0 and (spec.phase != "refine" or self.schedule.refine_steps > 0)
        }
        self.rasterizer: Rasterizer = make_rasterizer(self.config.rasterizer)
        self._known_extent: tuple[Tensor, int, float] | None = None
        self.grid: VisibilityGrid | None = None
        self._members: ClassMembers | None = None
        self.step = 0
        self.seed = 0
        self.frozen = False
        self.growing = False
        self.prepared_seconds: dict[str, float] = {}
        self.preparing_seconds = 0.0
        self.refining_since = 0.0
        self.crop_box: OrientedBox | None = None
        self.background_color = fixed_background(self.config)
        self.drawn: Drawn | None = None
        self.clock = StepClock()
        self.measuring = True  # whether anyone will read this step's metrics
        self.viewing = Viewing(self)
        self.viewer_panel = ObjectPanel(self.viewing)  # nerfstudio finds both by being public attributes
        self.viewer_link = ViewerLink(self.viewer_panel)

    def update_to_step(self, step: int) -> None:
        """Called with a checkpoint's step before it is loaded."""
        self.step = step

    def extent_on_host(self) -> float:
        """``extent``, world units, fetched from a GPU once only, lest every step wait for it."""
        known = self._known_extent
        if known is None or known[0] is not self.extent or known[1] != self.extent._version:
            self._known_extent = known = (self.extent, self.extent._version, float(self.extent))
        return known[2]

    # -- rendering ---------------------------------------------------------------------------------------------------

    def settings(self, geometry: bool = True, distortion: bool = False) -> RasterSettings:
        """Depth range of the scene and what to compute."""
        extent = self.extent_on_host()
        return RasterSettings(self.config.near * extent, self.config.far * extent, geometry, distortion)

    def active_sh_degree(self) -> int:
        """Degrees grow one by one while the base trains; a scene that is only looked at shows them all."""
        if not self.training or self.schedule.warm or self.schedule.refining(self.step):
            return self.config.sh_degree
        interval = max(self.schedule.scaled(self.config.sh_degree_interval), 1)
        return min(self.step // interval, self.config.sh_degree)

    def active_losses(self) -> dict[str, Loss]:
        """The terms that count at the current step."""
        if self.frozen:
            return {}
        return {name: loss for name, loss in self.losses.items() if loss.active(self.step)}

    def get_outputs(self, camera: Cameras) -> dict[str, Any]:
        """Render one view: what training needs while training; else what a viewer is to show, or the whole scene."""
        if self.training:
            return self._training_outputs(camera)
        with torch.no_grad():
            view = camera_from_nerfstudio(camera, 0).to(self.device)
            return self.viewing.outputs(view) if asked_by_viewer() else scene_outputs(self, view)

    def _training_outputs(self, cameras: Cameras) -> dict[str, Any]:
        self.clock.mark("data")
        known = (cameras.metadata or {}).get("camera")  # whose numbers the host has too
        camera = known or camera_from_nerfstudio(cameras, 0).to(self.device)
        needs = frozenset().union(*(loss.needs for loss in self.active_losses().values()))
        target = (cameras.metadata or {}).get("class_map") if "boundary" in needs else None
        background = self._training_background()
        inputs = surfel_inputs(
            self.surfels(), camera, self.active_sh_degree(), self.class_ids if target is not None else None
        )
        if self.growing:
            inputs = replace(inputs, screen_shift=torch.zeros_like(inputs.means[:, :2]).requires_grad_())
        labels = None if target is None else target.to(self.device, torch.int32)
        settings = self.settings(geometry="geometry" in needs, distortion="distortion" in needs)
        render = self.rasterizer.rasterize(inputs, camera, settings, background, labels)
        self.drawn = Drawn(camera, render, inputs.screen_shift, labels)
        self.clock.mark("drawing")
        outputs = {"rgb": render.color, "accumulation": render.alpha[..., None], "background": background}
        if render.depth is not None:
            outputs["depth"] = render.depth[..., None]
        return outputs

    def _training_background(self) -> Tensor:
        if self.config.background_color == "random":
            generator = torch.Generator().manual_seed(self.seed * 1_000_003 + self.step)
            return sent(torch.rand(3, generator=generator), self.device)
        return fixed_background(self.config, self.device)

    def set_background(self, background_color: Tensor) -> None:
        """Take the viewer's background [3]: for its pictures alone, so that no figure depends on it."""
        self.viewing.background = background_color

    # -- losses and metrics --------------------------------------------------------------------------------------------

    def _truth(self, batch: dict[str, Any], background: Tensor) -> Tensor:
        """The photograph [H, W, 3]; where it is transparent, the background shows, as it does behind the Gaussians."""
        image = self.get_gt_img(batch["image"])
        if "alpha" in batch:  # it comes on black
            image = image + (1.0 - self.get_gt_img(batch["alpha"])[..., None]) * background
        return image

    def get_gt_img(self, image: Tensor) -> Tensor:
        """[H, W, C] float in 0..1 on the model's device; never downscaled."""
        return (image.float() / 255.0 if image.dtype == torch.uint8 else image).to(self.device)

    def get_metrics_dict(self, outputs: dict[str, Any], batch: dict[str, Any]) -> dict[str, Any]:
        """The number of Gaussians and, in a step whose metrics are read, PSNR of the drawn view."""
        metrics: dict[str, Any] = {"gaussian_count": self.num_points}
        if self.measuring:
            with torch.no_grad():
                error = (outputs["rgb"] - self._truth(batch, outputs["background"])).square().mean()
            metrics["psnr"] = -10.0 * torch.log10(error.clamp_min(1e-10))
        return metrics

    def get_loss_dict(
        self, outputs: dict[str, Any], batch: dict[str, Any], metrics_dict: dict[str, Any] | None = None
    ) -> dict[str, Tensor]:
        """Each active term by name, weighted."""
        image = self._truth(batch, outputs["background"])
        if not self.training or self.drawn is None:
            return {"photometric": (outputs["rgb"] - image).abs().mean()}
        class_map = batch.get("class_map")
        inputs = LossInputs(
            step=self.step,
            seed=self.seed,
            surfels=self.surfels(),
            camera=self.drawn.camera,
            render=self.drawn.render,
            image=image,
            labels=None if class_map is None else class_map.to(self.device, torch.int32),
            class_ids=self.class_ids,
            grid=self.grid,
            draw=self._draw_apart,
            members=self._class_members(),
            present=batch.get("present"),
        )
        terms = {name: loss.weighted(inputs) for name, loss in self.active_losses().items()}
        self.clock.mark("losses")
        # a frozen scene still needs something to call backward on; no parameter hangs on it, so none moves
        return terms or {"none": torch.zeros((), device=self.device, requires_grad=True)}

    def _draw_apart(self, inputs: SurfelInputs, camera: Camera) -> RasterOutputs:
        """Surfels that a loss wants to see apart from the scene, with geometry, on black."""
        return self.rasterizer.rasterize(inputs, camera, self.settings(), inputs.means.new_zeros(3))

    def _class_members(self) -> ClassMembers:
        if self._members is None or not self._members.current(self.class_ids):
            self._members = ClassMembers(self.class_ids)
        return self._members

    def get_image_metrics_and_images(
        self, outputs: dict[str, Any], batch: dict[str, Any]
    ) -> tuple[dict[str, float], dict[str, Tensor]]:
        """PSNR and SSIM of an evaluation view, and pictures for tensorboard."""
        image = self._truth(batch, outputs["background"])
        error = (outputs["rgb"] - image).square().mean()
        metrics = {
            "psnr": float(-10.0 * torch.log10(error.clamp_min(1e-10))),
            "ssim": float(ssim(outputs["rgb"], image)),
        }
        images = {"img": torch.cat([image, outputs["rgb"]], dim=1)}
        if "class_map" in outputs:
            images["class_map"] = outputs["class_map"]
        return metrics, images

    def get_training_callbacks(
        self, training_callback_attributes: TrainingCallbackAttributes
    ) -> list[TrainingCallback]:
        """Schedules, densification and the switch to refinement: see ``plugin.training``."""
        return training_callbacks(self, training_callback_attributes)
