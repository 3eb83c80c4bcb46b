"""The device that a run trains on."""

from __future__ import annotations

import torch
from nerfstudio.configs.base_config import MachineConfig

from beags_plugin.ops import cuda_extension
from beags_plugin.rasterizers import first_contact
from beags_plugin.system.errors import UserError


def default_device() -> str:
    """Return the default device: "cuda" where there is a GPU on which our kernels have passed a trial, else "cpu"."""
    first_contact.settle()
    return "cpu" if cuda_extension.status()[1] else "cuda"


def check_machine(machine: MachineConfig) -> None:
    """Raise ``UserError`` for missing devices."""
    for name in ("num_devices", "num_machines"):
        if (count := getattr(machine, name)) < 1:
            raise UserError(f"--machine.{name.replace('_', '-')} is {count}: give 1 or more.")
    if machine.device_type == "cuda":
        if reason := cuda_extension.status()[1]:
            raise UserError(
                f"--machine.device-type cuda: {reason} Or train with --machine.device-type cpu (beags resume: --device "
                "cpu)."
            )
        there = torch.cuda.device_count()
        if machine.num_devices > there:
            raise UserError(f"--machine.num-devices is {machine.num_devices}, but this machine has {there} GPU(s).")
    elif machine.num_devices * machine.num_machines > 1:
        raise UserError(
            f"--machine.num-devices is {machine.num_devices}, but nerfstudio starts several processes for GPUs only: "
            "leave it at 1 on a CPU, where one process uses all cores."
        )
