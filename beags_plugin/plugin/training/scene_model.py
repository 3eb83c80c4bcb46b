"""The scene as a nerfstudio model, and the state that a run changes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.models.splatfacto import SplatfactoModel
from torch import Tensor, nn

from beags_plugin.core.cameras import Camera
from beags_plugin.core.exposure import Exposures
from beags_plugin.core.membership import Membership
from beags_plugin.core.surfels import Surfels
from beags_plugin.losses import make_loss
from beags_plugin.losses.base import Loss
from beags_plugin.occupancy.grid import VisibilityGrid
from beags_plugin.plugin.options.model_options import BeagsModelConfig
from beags_plugin.preparation.refiner_training import OwnTraining
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.rasterizers.interface import Rasterizer, RasterOutputs, RasterSettings, SurfelInputs
from beags_plugin.rasterizers.rendering import fixed_background
from beags_plugin.runs.checkpoint_file import exposures_of, extra_state
from beags_plugin.splat_io.ply import thin_log_scales

PARAMETER_GROUPS = ("means", "features_dc", "features_rest", "opacities", "scales", "quats")


@dataclass(frozen=True)
class LastRender:
    """The render of the last training step.

    screen_shift: [N, 2] of ``SurfelInputs``; densification reads its gradient. labels: [H, W] int32 of the view; None
    if it has no mask. close_up: whether the view is a close-up.
    """

    camera: Camera
    render: RasterOutputs
    screen_shift: Tensor | None
    labels: Tensor | None = None
    close_up: bool = False


class SceneModel(SplatfactoModel):
    """N Gaussians as parameters, their classes as buffers, and the state of the run that trains them.

    It derives from nerfstudio's ``SplatfactoModel``, because ns-export and the viewer check for that type; its training
    is not used.

    classes: id to name. objects: see ``Membership``. step, seed: of the run. grid: voxels of the classes; None before
    refinement. growing: whether this step gathers gradients for densification. frozen: whether the refiner leaves the
    scene as it is. own_training: of a refiner that makes its steps itself. last_render: of the last training step.
    measuring: whether this step's metrics are read. prepared: whether this run has prepared its refinement; None
    outside training. exposures: of the training photos; None if all have the same. photo_colors: turns colours [N, 3]
    of the scene into those of a training photo, by its index; None without exposures. crop_box: nerfstudio's.
    """

    config: BeagsModelConfig
    classes: dict[int, str]
    # These are buffers, declared for type checkers.
    class_ids: Tensor  # [N] int32
    class_margin: Tensor  # [N] float32
    assigned: Tensor  # [] bool
    extent: Tensor  # [] float32, world units
    refined_steps: Tensor  # [] int64, refinement steps of the scene so far

    def hold(self, surfels: Surfels, classes: Mapping[int, str]) -> None:
        """Create the parameters and buffers of a scene without classes; called once."""
        self.gauss_params = nn.ParameterDict({name: nn.Parameter(value) for name, value in _by_group(surfels).items()})
        self.register_buffer("class_ids", torch.zeros(len(surfels), dtype=torch.int32))
        self.register_buffer("class_margin", torch.zeros(len(surfels)))
        self.register_buffer("assigned", torch.tensor(False))
        self.register_buffer("extent", torch.tensor(1.0))
        self.register_buffer("refined_steps", torch.tensor(0))
        self.classes = dict(classes)
        self.objects: Mapping[int, Tensor] | None = None
        self.exposures: Exposures | None = None
        self.photo_colors: Callable[[Tensor, int], Tensor] | None = None
        self.schedule = self.config.schedule()
        self.losses: dict[str, Loss] = {
            name: make_loss(name, spec, self.schedule)
            for name, spec in self.config.losses.items()
            if spec.weight != 0.0 and (spec.phase != "refine" or self.schedule.refine_steps > 0)
        }
        self.rasterizer: Rasterizer = make_rasterizer(self.config.rasterizer)
        self.background_color = fixed_background(self.config)
        self.crop_box: OrientedBox | None = None
        self.step = 0
        self.seed = 0
        self.grid: VisibilityGrid | None = None
        self.growing = False
        self.frozen = False
        self.own_training: OwnTraining | None = None
        self.last_render: LastRender | None = None
        self.measuring = True
        self.prepared: bool | None = None
        self._known_extent: tuple[Tensor, int, float] | None = None

    # -- what is rendered, and how -----------------------------------------------------------------------------------

    def extent_on_host(self) -> float:
        """Return ``extent``, world units; it is fetched from a GPU only once, so that no step waits for it."""
        known = self._known_extent
        if known is None or known[0] is not self.extent or known[1] != self.extent._version:
            self._known_extent = known = (self.extent, self.extent._version, float(self.extent))
        return known[2]

    def settings(self, geometry: bool = True, distortion: bool = False) -> RasterSettings:
        """Return the scene's depth range and what to compute."""
        extent = self.extent_on_host()
        return RasterSettings(self.config.near * extent, self.config.far * extent, geometry, distortion)

    def active_sh_degree(self) -> int:
        """Return the SH degree to render: while the base trains it grows by one at a time up to the full degree."""
        if not self.training or self.schedule.warm or self.schedule.refining(self.step):
            return self.config.sh_degree
        interval = max(self.schedule.scaled(self.config.sh_degree_interval), 1)
        return min(self.step // interval, self.config.sh_degree)

    def active_losses(self) -> dict[str, Loss]:
        """Return the terms that count at the current step."""
        if self.frozen:
            return {}
        skips_refine = self.own_training is not None
        return {
            name: loss
            for name, loss in self.losses.items()
            if loss.active(self.step) and not (skips_refine and self.config.losses[name].phase == "refine")
        }

    def generator(self, step: int) -> torch.Generator:
        """Return a generator seeded by (seed, step), so that a resumed run draws the same numbers."""
        return torch.Generator().manual_seed(self.seed * 1_000_003 + step)

    # -- Gaussians ---------------------------------------------------------------------------------------------------

    @property
    def scales(self) -> Tensor:
        """[N, 3] logs of the scales for exporters; the third, which the parameter lacks, is thin."""
        return thin_log_scales(self.gauss_params["scales"])

    def surfels(self) -> Surfels:
        """Return the scene; it shares storage and gradients with the parameters."""
        return Surfels(
            means=self.gauss_params["means"],
            quats=self.gauss_params["quats"],
            log_scales=self.gauss_params["scales"],
            opacity_logits=self.gauss_params["opacities"].view(-1),
            sh_dc=self.gauss_params["features_dc"],
            sh_rest=self.gauss_params["features_rest"],
        )

    def members(self) -> Membership:
        """Return which Gaussians belong to which class."""
        return Membership(self.class_ids, self.objects)

    def take_members(self, members: Membership) -> None:
        """Set the classes of all Gaussians."""
        self.class_ids = members.class_ids.int().to(self.device)
        self.objects = members.objects
        self.assigned.fill_(True)

    def replace_surfels(self, surfels: Surfels) -> None:
        """Replace all parameters, in any number and SH degree; classes are reset."""
        self.config.sh_degree = surfels.sh_degree
        # The parameters are new objects, because autograd keeps the size of those in the last step's graph.
        for name, value in _by_group(surfels).items():
            self.gauss_params[name] = nn.Parameter(value.detach().to(self.device).contiguous())
        self._reset_classes(len(surfels))

    def _reset_classes(self, count: int) -> None:
        self.class_ids = torch.zeros(count, dtype=torch.int32, device=self.device)
        self.class_margin = torch.zeros(count, device=self.device)
        self.objects = None

    def take_classes(self, classes: Mapping[int, str]) -> None:
        """Set other classes; no Gaussian has one of them yet."""
        self.classes = dict(classes)
        self._reset_classes(self.num_points)
        self.assigned.fill_(False)

    # -- checkpoints -------------------------------------------------------------------------------------------------

    def load_state_dict(self, state: Mapping[str, Any], **kwargs) -> Any:
        """Load a checkpoint of any number of Gaussians; parameters are resized in place (optimizers hold them)."""
        # Colours are rendered with the SH degree of their training, whatever this config says.
        self.config.sh_degree = round((state["gauss_params.features_rest"].shape[1] + 1) ** 0.5) - 1
        for name, parameter in self.gauss_params.items():
            parameter.data = torch.zeros_like(state[f"gauss_params.{name}"], device=self.device)
        self._reset_classes(len(state["gauss_params.means"]))
        return nn.Module.load_state_dict(self, state, **kwargs)  # type: ignore[arg-type]

    def get_extra_state(self) -> dict[str, Any]:
        """Return the checkpoint's content besides tensors by name: class names, objects and exposures."""
        return extra_state(self.classes, self.members(), self.exposures)

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Set class names, objects and exposures from a checkpoint."""
        self.classes = {int(index): str(name) for index, name in state["classes"].items()}
        self.objects = state.get("objects")
        self.exposures = exposures_of(state)

    def get_param_groups(self) -> dict[str, list[nn.Parameter]]:
        """Return one optimizer group per kind of parameter."""
        return {name: [self.gauss_params[name]] for name in PARAMETER_GROUPS}


def picture(model: SceneModel, inputs: SurfelInputs, camera: Camera) -> Tensor:
    """Render colours [H, W, 3] in 0..1 of Gaussians on the scene's background."""
    background, settings = model.background_color.to(model.device), model.settings(geometry=False)
    return model.rasterizer.rasterize(inputs, camera, settings, background).color.clamp(0.0, 1.0)


def _by_group(surfels: Surfels) -> dict[str, Tensor]:
    """Return the Gaussians' values by the names of splatfacto's groups of parameters."""
    values = (surfels.means, surfels.sh_dc, surfels.sh_rest, surfels.opacity_logits[:, None])
    return dict(zip(PARAMETER_GROUPS, (*values, surfels.log_scales, surfels.quats), strict=True))
