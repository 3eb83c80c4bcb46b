"""One step of several Adam optimizers, without what torch does around each of them."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor
from torch.optim import Adam, Optimizer

_ONE = torch.ones((), dtype=torch.float32, device="cpu")


def clear_gradients(optimizers: Iterable[Optimizer]) -> None:
    """``Optimizer.zero_grad`` of each: no parameter has a gradient afterwards."""
    for optimizer in optimizers:
        for group in optimizer.param_groups:
            for parameter in group["params"]:
                parameter.grad = None


@torch.no_grad()
def step_all(optimizers: Iterable[Optimizer]) -> None:
    """``Optimizer.step`` of each: the same bits, and the same state afterwards.

    With few surfels, what torch does around its fused kernel takes twenty times as long as the kernel. Optimizers that
    ask for more than the kernel alone (hooks, amsgrad, another class, no ``fused``) take torch's way.
    """
    jobs: list[tuple[dict, list[Tensor], list[dict[str, Tensor]]]] = []
    for optimizer in optimizers:
        if not _is_plain(optimizer):
            with torch.enable_grad():
                optimizer.step()
            continue
        for group in optimizer.param_groups:
            parameters = [value for value in group["params"] if value.grad is not None]
            if parameters:
                jobs.append((group, parameters, [_state(optimizer, value) for value in parameters]))
    if not jobs:
        return
    counts = [state["step"] for _, _, states in jobs for state in states]
    if all(count.is_cpu for count in counts):
        torch._foreach_add_(  # pyright: ignore[reportPrivateImportUsage]
            counts, _ONE, alpha=1.0
        )  # a number would become a tensor again for each of them
    else:
        torch._foreach_add_(counts, 1)  # pyright: ignore[reportPrivateImportUsage]
    for group, parameters, states in jobs:
        first, second = group["betas"]
        torch._fused_adam_(  # pyright: ignore[reportPrivateImportUsage]
            parameters,
            [value.grad for value in parameters],  # type: ignore[misc]
            [state["exp_avg"] for state in states],
            [state["exp_avg_sq"] for state in states],
            [],
            [state["step"] for state in states],
            lr=group["lr"],
            beta1=first,
            beta2=second,
            weight_decay=group["weight_decay"],
            eps=group["eps"],
            amsgrad=False,
            maximize=group["maximize"],
        )


def _is_plain(optimizer: Optimizer) -> bool:
    """Whether nothing is asked for but the fused kernel."""
    patched = "step" in vars(optimizer)  # torch's schedulers do that, to warn of a wrong order
    hooked = optimizer._optimizer_step_pre_hooks or optimizer._optimizer_step_post_hooks
    if type(optimizer) is not Adam or patched or hooked:
        return False
    for group in optimizer.param_groups:
        extended = group["amsgrad"] or group.get("decoupled_weight_decay", False)
        if not group["fused"] or extended or not isinstance(group["lr"], float):
            return False
    return True


def _state(optimizer: Optimizer, parameter: Tensor) -> dict[str, Tensor]:
    """What Adam knows of a parameter; made as torch makes it if there is nothing yet."""
    state = optimizer.state[parameter]
    if not state:
        state["step"] = torch.zeros((), dtype=torch.float32, device=parameter.device)
        state["exp_avg"] = torch.zeros_like(parameter, memory_format=torch.preserve_format)
        state["exp_avg_sq"] = torch.zeros_like(parameter, memory_format=torch.preserve_format)
    return state
