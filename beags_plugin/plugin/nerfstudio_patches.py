"""A patch by which torch loads the checkpoints of nerfstudio 1.1.5; importing this module applies it."""

from __future__ import annotations

import numpy as np
import torch


def allow_numpy_scalars_in_checkpoints() -> None:
    """Let ``torch.load(weights_only=True)`` accept numpy float scalars; without effect where it already does.

    nerfstudio's exponential scheduler returns numpy scalars, which torch saves in the optimizer's state and refuses to
    load by default.
    """
    add = getattr(torch.serialization, "add_safe_globals", None)
    if add is None:  # torch before 2.4 has no such list and loads everything
        return
    scalar = np.float64(0).__reduce__()[0]  # numpy moved it between 1.x and 2.x: ask for it instead of naming it
    add([scalar, np.dtype, type(np.dtype("float64")), type(np.dtype("float32"))])


allow_numpy_scalars_in_checkpoints()
