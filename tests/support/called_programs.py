"""Commands of beags and ns-train, run in this process: that saves their start of several seconds."""

from __future__ import annotations

import io
import sys
from contextlib import redirect_stdout
from unittest.mock import patch


def called(*command: object) -> str:
    """Run ns-train or beags with its arguments to a good end; return what it printed."""
    from nerfstudio.scripts.train import entrypoint

    from beags_plugin.commands.cli import main

    words, out = [str(word) for word in command], io.StringIO()
    with patch.object(sys, "argv", words), redirect_stdout(out):
        entrypoint() if words[0] == "ns-train" else main(words[1:])
    return out.getvalue()
