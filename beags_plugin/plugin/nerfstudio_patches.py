"""Lets torch load the checkpoints that nerfstudio 1.1.5 writes; importing this module applies it."""

from __future__ import annotations

import numpy as np
import torch


def allow_numpy_scalars_in_checkpoints() -> None:
    """Let ``torch.load(weights_only=True)`` accept numpy float scalars; without effect where it already does.

    nerfstudio's exponential scheduler returns numpy scalars, torch saves them in the optimizer's and scheduler's state,
    and nerfstudio's trainer then loads the checkpoint with torch's default, which refuses them.
    """
    add = getattr(torch.serialization, "add_safe_globals", None)
    if add is None:  # torch before 2.4 has no such list and loads everything
        return
    scalar = np.float64(0).__reduce__()[0]  # numpy moved it between 1.x and 2.x: ask for it instead of naming it
    add([scalar, np.dtype, type(np.dtype("float64")), type(np.dtype("float32"))])


allow_numpy_scalars_in_checkpoints()
