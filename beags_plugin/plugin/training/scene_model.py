"""A scene of surfels with classes as nerfstudio's models hold one: parameters, buffers, checkpoints of any size."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from nerfstudio.models.splatfacto import SplatfactoModel
from torch import Tensor, nn

from beags_plugin.core.surfels import Surfels

PARAMETER_GROUPS = ("means", "features_dc", "features_rest", "opacities", "scales", "quats")
FLATNESS = 1e-3  # exported third scale, relative to the smaller of the two: flat, yet no viewer divides by 0


class SurfelModel(SplatfactoModel):
    """What a model holds of its scene: N surfels as parameters, their classes as buffers, the classes' names.

    It derives from nerfstudio's ``SplatfactoModel`` because ns-export and the viewer ask for that type, but shares
    none of its training.
    """

    classes: dict[int, str]
    # buffers, for type checkers
    class_ids: Tensor  # [N] int32
    class_margin: Tensor  # [N] float32

    def hold(self, surfels: Surfels) -> None:
        """Make the parameters and buffers of a scene without classes; called once."""
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

    def get_param_groups(self) -> dict[str, list[nn.Parameter]]:
        """One optimizer group per kind of parameter."""
        return {name: [self.gauss_params[name]] for name in PARAMETER_GROUPS}
