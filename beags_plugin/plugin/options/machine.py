"""The device that a run trains on."""

from __future__ import annotations

from nerfstudio.configs.base_config import MachineConfig

from beags_plugin.ops import cuda_extension
from beags_plugin.rasterizers import first_contact
from beags_plugin.system.errors import UserError


def default_device() -> str:
    """Return "cuda" if there is a GPU on which our kernels have passed a trial, else "cpu"."""
    first_contact.settle()
    return "cpu" if cuda_extension.status()[1] else "cuda"


def check_machine(machine: MachineConfig) -> None:
    """Raise ``UserError`` for a missing device, or several."""
    for name in ("num_devices", "num_machines"):
        if (count := getattr(machine, name)) != 1:
            raise UserError(
                f"--machine.{name.replace('_', '-')} is {count}: a scene is trained on one device, so leave it at 1; "
                "docs/experiments.md says how to train several scenes at once."
            )
    if machine.device_type == "cuda" and (reason := cuda_extension.status()[1]):
        raise UserError(
            f"--machine.device-type cuda: {reason} Or train with --machine.device-type cpu (beags resume: --device "
            "cpu)."
        )
