"""nerfstudio's optimizers, one for each group of parameters, stepped together."""

from __future__ import annotations

from typing import Any

from nerfstudio.engine.optimizers import Optimizers
from torch.cuda.amp.grad_scaler import GradScaler

from beags_plugin.core.adam import clear_gradients, step_all
from beags_plugin.plugin.training.replicas import average_gradients
from beags_plugin.plugin.training.timing import StepClock


class JointOptimizers(Optimizers):
    """``Optimizers`` whose groups are cleared and stepped in one go; optimizers, states and files are nerfstudio's."""

    def __init__(self, config: dict[str, Any], param_groups: dict[str, Any], clock: StepClock | None = None) -> None:
        super().__init__(config, param_groups)
        self.clock = clock or StepClock()

    def zero_grad_some(self, param_groups: list[str]) -> None:
        """See ``Optimizers.zero_grad_some``."""
        clear_gradients(self.optimizers[name] for name in param_groups)

    def optimizer_scaler_step_some(self, grad_scaler: GradScaler, param_groups: list[str]) -> None:
        """See ``Optimizers.optimizer_scaler_step_some``; scaled or clipped gradients go nerfstudio's way."""
        self.clock.mark("backward")
        groups = [group for name in param_groups for group in self.optimizers[name].param_groups]
        # not `self.parameters`: those are the ones that training began with
        average_gradients(value for group in groups for value in group["params"])
        if grad_scaler.is_enabled():
            super().optimizer_scaler_step_some(grad_scaler, param_groups)
        else:
            self._step_together(grad_scaler, param_groups)
        self.clock.mark("optimizer")

    def _step_together(self, grad_scaler: GradScaler, param_groups: list[str]) -> None:
        clipped = [name for name in param_groups if self.config[name]["optimizer"].max_norm is not None]
        super().optimizer_scaler_step_some(grad_scaler, clipped)
        step_all(self.optimizers[name] for name in param_groups if name not in clipped)
