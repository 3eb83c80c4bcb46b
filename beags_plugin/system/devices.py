"""Copies of tensors from the host to a GPU."""

from __future__ import annotations

import torch
from torch import Tensor


def to_device_async(value: Tensor, device: torch.device | str) -> Tensor:
    """Copy ``value`` from the CPU to ``device``; the host does not wait until it is there."""
    if torch.device(device).type != "cuda":
        return value.to(device)
    return value.pin_memory().to(device, non_blocking=True)  # the host waits for copies of memory that is not pinned
