"""Module that runs of the first format name in config.yml: it rejects them, in nerfstudio's programs too."""

from __future__ import annotations

from beags_plugin.options.run_format import other_format
from beags_plugin.system.errors import print_user_errors_plainly


def __getattr__(name: str) -> None:
    if name == "BeagsTrainerConfig":
        print_user_errors_plainly()
        raise other_format("this run")
    raise AttributeError(name)
