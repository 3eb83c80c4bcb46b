"""What is changed in nerfstudio 1.1.5: its own checkpoints load again, and its viewer listens on this machine alone.

Importing this module applies it.
"""

from __future__ import annotations

import inspect

import numpy as np
import torch
from nerfstudio.configs.base_config import ViewerConfig

LOCAL = "127.0.0.1"


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


def listen_on_this_machine() -> None:
    """Let ``ns-viewer`` listen on 127.0.0.1 unless it is told ``--viewer.websocket-host``: nerfstudio's 0.0.0.0 lets
    everyone on the network look, and press the viewer's buttons.

    ``ns-train`` follows the configs of methods, and nerfstudio has made those of its own before.
    """
    fields = getattr(ViewerConfig, "__dataclass_fields__")  # noqa: B009  (type checkers do not know it)
    fields["websocket_host"].default = ViewerConfig.websocket_host = LOCAL
    start = ViewerConfig.__init__
    names = [name for name, each in inspect.signature(start).parameters.items() if each.default is not each.empty]
    defaults = dict(zip(names, start.__defaults__ or (), strict=True))
    start.__defaults__ = tuple({**defaults, "websocket_host": LOCAL}.values())


allow_numpy_scalars_in_checkpoints()
listen_on_this_machine()
