"""Training from Python, exactly as ``ns-train`` does it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from beags_plugin.errors import UserError

if TYPE_CHECKING:
    from beags_plugin.plugin.config import BeagsTrainerConfig


def train(config: BeagsTrainerConfig) -> None:
    """Run the training that ``config`` describes; its ``run_dir`` says where.

    Raises ``UserError`` for a user's mistake, where ``ns-train`` would print it and end.
    """
    from nerfstudio.scripts.train import main

    try:
        main(config)
    except SystemExit as end:
        if isinstance(end.__cause__, UserError):
            raise end.__cause__ from None
        raise
    if not (config.get_base_dir() / "training.json").exists():
        raise KeyboardInterrupt  # nerfstudio prints an interrupt and returns
