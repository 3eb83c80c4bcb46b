"""The nerfstudio model: a 2D-Gaussian-splatting scene with classes, trained by the losses its config lists."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes
from nerfstudio.models.base_model import Model, ModelConfig
from nerfstudio.models.splatfacto import SplatfactoModel
from torch import Tensor, nn

from beags_plugin.core.cameras import Camera
from beags_plugin.core.densification import DensifyConfig, initial_surfels
from beags_plugin.core.surfels import Surfels
from beags_plugin.losses import LOSSES
from beags_plugin.losses.base import Loss, LossInputs
from beags_plugin.losses.photometric import ssim
from beags_plugin.occupancy.grid import VisibilityGrid
from beags_plugin.plugin.cameras import camera_from_nerfstudio
from beags_plugin.plugin.schedule import PhaseSchedule
from beags_plugin.plugin.step_clock import StepClock
from beags_plugin.plugin.training import training_callbacks
from beags_plugin.plugin.viewer_controls import ObjectPanel, ViewerLink
from beags_plugin.plugin.viewing import Viewing, asked_by_viewer, scene_outputs
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.rasterizers.drawing import surfel_inputs
from beags_plugin.rasterizers.interface import Rasterizer, RasterOutputs, RasterSettings, SurfelInputs
from beags_plugin.refiners.border_split import BorderSplitConfig
from beags_plugin.refiners.preparation import PreparationConfig

PARAMETER_GROUPS = ("means", "features_dc", "features_rest", "opacities", "scales", "quats")
FLATNESS = 1e-3  # exported third scale, relative to the smaller of the two: flat, yet no viewer divides by 0


@dataclass
class LossSpec:
    """One term of the training loss, as a config lists it."""

    weight: float = 1.0
    """Factor in the sum; 0 switches the term off."""
    phase: Literal["base", "refine", "both"] = "both"
    """Where the term may act."""
    start: int = 0
    """First step of the term: of the run, stated for a base of schedule_steps; or, for phase "refine", of the
    refinement, as it is."""
    options: dict[str, bool | int | float] = field(default_factory=dict)
    """Options of the loss itself, e.g. ssim_weight or samples."""

    def build(self, name: str, schedule: PhaseSchedule) -> Loss:
        """The loss, with its steps made absolute."""
        first = schedule.base_steps + self.start if self.phase == "refine" else schedule.scaled(self.start)
        if self.phase != "refine" and (schedule.base_steps == 0 or schedule.warm):
            first = 0  # the base was trained elsewhere: its terms have long started
        last = schedule.base_steps if self.phase == "base" else None
        return LOSSES.get(name)(weight=self.weight, start=first, stop=last, **self.options)


@dataclass
class BeagsModelConfig(ModelConfig):
    """Options of the scene and of its two training phases."""

    _target: type = field(default_factory=lambda: BeagsModel)
    rasterizer: str = "auto"
    """Backend: auto, native, torch, or one that another package registers."""
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


def fixed_background(config: BeagsModelConfig) -> Tensor:
    """[3], the colour behind a scene that is looked at or scored: the one that it was trained on, black for random."""
    return torch.full((3,), 1.0 if config.background_color == "white" else 0.0)


class BeagsModel(SplatfactoModel):
    """A scene of surfels with classes.

    It derives from nerfstudio's ``SplatfactoModel`` because ns-export and the viewer ask for that type, but shares
    none of its training: parameters, rendering, losses and callbacks are all its own.
    """

    config: BeagsModelConfig
    # buffers, for type checkers; the surfels are N
    class_ids: Tensor  # [N] int32
    class_margin: Tensor  # [N] float32
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
        surfels = initial_surfels(points, colors / 255.0, self.config.sh_degree, generator)
        self.gauss_params = nn.ParameterDict(
            {
                "means": nn.Parameter(surfels.means),
                "features_dc": nn.Parameter(surfels.sh_dc),
                "features_rest": nn.Parameter(surfels.sh_rest),
                "opacities": nn.Parameter(surfels.opacity_logits[:, None].contiguous()),
                "scales": nn.Parameter(surfels.log_scales),
                "quats": nn.Parameter(surfels.quats),
            }
        )
        self.register_buffer("class_ids", torch.zeros(len(surfels), dtype=torch.int32))
        self.register_buffer("class_margin", torch.zeros(len(surfels)))
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
        self.grid: VisibilityGrid | None = None
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

    # -- the scene ---------------------------------------------------------------------------------------------------

    @property
    def scales(self) -> Tensor:
        """[N, 3] logs of the scales as exporters want them: the third is thin; the parameter itself has two."""
        flat = self.gauss_params["scales"]
        thin = flat.min(dim=-1, keepdim=True).values + torch.log(flat.new_tensor(FLATNESS))
        return torch.cat([flat, thin], dim=-1)

    def surfels(self) -> Surfels:
        """The scene, sharing storage (and gradients) with the parameters."""
        return Surfels(
            means=self.gauss_params["means"],
            quats=self.gauss_params["quats"],
            log_scales=self.gauss_params["scales"],
            opacity_logits=self.gauss_params["opacities"].view(-1),
            sh_dc=self.gauss_params["features_dc"],
            sh_rest=self.gauss_params["features_rest"],
        )

    def replace_surfels(self, surfels: Surfels) -> None:
        """Put new parameters in place of all, of any number and degree; classes are reset.

        New ones, since autograd still knows the size of those that the last step's graph holds.
        """
        values = {
            "means": surfels.means,
            "features_dc": surfels.sh_dc,
            "features_rest": surfels.sh_rest,
            "opacities": surfels.opacity_logits[:, None],
            "scales": surfels.log_scales,
            "quats": surfels.quats,
        }
        self.config.sh_degree = surfels.sh_degree
        for name, value in values.items():
            self.gauss_params[name] = nn.Parameter(value.detach().to(self.device).contiguous())
        self.class_ids = torch.zeros(len(surfels), dtype=torch.int32, device=self.device)
        self.class_margin = torch.zeros(len(surfels), device=self.device)

    def load_state_dict(self, state: Mapping[str, Any], **kwargs) -> Any:
        """Load a checkpoint of any number of surfels; parameters are resized in place (optimizers hold them)."""
        count = state["gauss_params.means"].shape[0]
        # colours are shown as they were trained, whatever degree this config asks for
        self.config.sh_degree = round((state["gauss_params.features_rest"].shape[1] + 1) ** 0.5) - 1
        for name, parameter in self.gauss_params.items():
            parameter.data = torch.zeros_like(state[f"gauss_params.{name}"], device=self.device)
        self.class_ids = torch.zeros(count, dtype=torch.int32, device=self.device)
        self.class_margin = torch.zeros(count, device=self.device)
        return nn.Module.load_state_dict(self, state, **kwargs)  # type: ignore[arg-type]

    def get_extra_state(self) -> dict[str, Any]:
        """What a checkpoint keeps besides tensors: the class names."""
        return {"classes": dict(self.classes)}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Take the class names of a checkpoint."""
        self.classes = {int(index): str(name) for index, name in state["classes"].items()}

    def update_to_step(self, step: int) -> None:
        """Called with a checkpoint's step before it is loaded."""
        self.step = step

    def get_param_groups(self) -> dict[str, list[nn.Parameter]]:
        """One optimizer group per kind of parameter."""
        return {name: [self.gauss_params[name]] for name in PARAMETER_GROUPS}

    # -- rendering ---------------------------------------------------------------------------------------------------

    def settings(self, geometry: bool = True, distortion: bool = False) -> RasterSettings:
        """Depth range of the scene and what to compute."""
        extent = float(self.extent)
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
        camera = camera_from_nerfstudio(cameras, 0).to(self.device)
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
            return torch.rand(3, generator=generator).to(self.device)
        return fixed_background(self.config).to(self.device)

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
        )
        terms = {name: loss.weighted(inputs) for name, loss in self.active_losses().items()}
        self.clock.mark("losses")
        # a frozen scene still needs something to call backward on; no parameter hangs on it, so none moves
        return terms or {"none": torch.zeros((), device=self.device, requires_grad=True)}

    def _draw_apart(self, inputs: SurfelInputs, camera: Camera) -> RasterOutputs:
        """Surfels that a loss wants to see apart from the scene, with geometry, on black."""
        return self.rasterizer.rasterize(inputs, camera, self.settings(), inputs.means.new_zeros(3))

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
