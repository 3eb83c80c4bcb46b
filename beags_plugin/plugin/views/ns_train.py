"""Prepare ns-train for a method of ours, before it imports nerfstudio's own methods.

Nerfstudio loads data parsers of other packages long before their methods, so our data parser calls this.
"""

from __future__ import annotations

import sys
from typing import Any

from beags_plugin.system.errors import UserError, check_choice, meant, silence_libraries
from beags_plugin.system.program import program_name
from beags_plugin.system.shipped import shipped_names


def prepare() -> None:
    """Make ns-train of a preset of ours quicker and quieter; exit with one sentence if the preset is misspelt.

    Other programs, and ns-train with other methods, are left as they are.
    """
    words = sys.argv[1:]
    name = words[0] if words else ""
    presets = shipped_names("method_configs")
    if program_name() != "ns-train" or not (name.startswith("beags") or meant(name, presets)):
        return
    try:
        check_choice(name, presets, "preset")
    except UserError as error:
        print(f"beags: {error}", file=sys.stderr)
        sys.exit(2)
    silence_libraries()
    _leave_out_other_methods()


def _leave_out_other_methods() -> None:
    """Skip nerfstudio's work at each start for methods other than the named one.

    For every method that could be installed it walks over all modules of the process, and for one function of
    splatfacto it imports torch's compiler.
    """
    from nerfstudio.configs import external_methods
    from nerfstudio.utils import misc

    external_methods.external_methods.clear()

    def plain(*arguments: Any, **_: Any) -> Any:
        return arguments[0] if arguments else lambda function: function

    misc.torch_compile = plain
