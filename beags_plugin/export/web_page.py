"""One self-contained .html of an object: viser's viewer with the Gaussians inside, which loads no other file."""

from __future__ import annotations

import base64
import gzip
import html
import math
import re
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch

from beags_plugin.core.rotations import rotation_from_quat
from beags_plugin.core.sh import SH_C0
from beags_plugin.export.base import Exporter
from beags_plugin.export.page_colors import SeenColors, seen_colors
from beags_plugin.export.splat_values import SplatValues, splat_values
from beags_plugin.splat_io.files import write_bytes
from beags_plugin.surfaces.frames import bounding_box
from beags_plugin.surfaces.item import ExportItem
from beags_plugin.system.errors import UserError

_FIELD_OF_VIEW = math.radians(40.0)  # vertical
_SCENE = "scene.viser"  # name under which the viewer requests its recording
_SKY = "potsdamer_platz_1k.hdr"  # name under which it requests the light of meshes, of which there are none
_DARK = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 1 +X 1\n\x80\x80\x80\x80"  # an .hdr of one grey pixel
_START = 'get("playbackPath")'
_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval' data:; worker-src data:; connect-src data:; "
    "style-src 'unsafe-inline'; img-src data: blob:"
)
"""The page's policy: it may load only data that it holds itself."""


@dataclass(frozen=True)
class WebPageExporter(Exporter):
    """A page to share, with the viewer of viser, which comes with nerfstudio. Colours do not change with the view.

    At first the object fills the image, seen from the training camera that shows most of it.
    """

    suffix: ClassVar[str] = "html"
    needs_views: ClassVar[bool] = True

    @classmethod
    def unavailable(cls) -> str | None:
        try:
            _viewer()
        except (ImportError, UserError) as error:
            return f"{error}".rstrip(".") + "; pip install viser==0.2.7."
        return None

    def write(self, path: Path, item: ExportItem) -> dict[str, Any]:
        if item.views is None:
            raise ValueError("a page needs the views of the training photos")
        splat_values(item.surfels, item.name)  # It raises NothingToExport before anything is rendered.
        seen = seen_colors(item.surfels, item.views, item.on_render)
        write_bytes(path, web_page(item.name, recording(item, seen)).encode())
        return {}


def recording(item: ExportItem, seen: SeenColors) -> bytes:
    """Return viser's recording of one moment: the Gaussians in a ball of radius 1, and the camera."""
    from msgspec import msgpack  # viser's own encoder
    from viser import _messages as messages  # nerfstudio pins viser; its public interface needs a server's port

    low, high = (end.numpy() for end in bounding_box(item.surfels))
    middle = (low + high) / 2
    radius = max(float(np.linalg.norm(high - low)) / 2, 1e-9)
    values = splat_values(seen.surfels, item.name)
    away = seen.eye - middle
    away = 1.0 / math.sin(_FIELD_OF_VIEW / 2) * (away / max(float(np.linalg.norm(away)), 1e-12))
    moment = [
        messages.GaussianSplatsMessage("/object", splat_buffer(values, middle, radius)),
        messages.SetSceneNodeVisibilityMessage("/WorldAxes", False),
        messages.SetCameraFovMessage(_FIELD_OF_VIEW),
        messages.SetCameraUpDirectionMessage(_three(seen.up)),
        messages.SetCameraPositionMessage(_three(away)),
        messages.SetCameraLookAtMessage((0.0, 0.0, 0.0)),
    ]
    content = {
        "loopStartIndex": None,
        "durationSeconds": 0.0,
        "messages": [(0.0, message.as_serializable_dict()) for message in moment],
    }
    return gzip.compress(msgpack.encode(content), mtime=0)


def splat_buffer(values: SplatValues, middle: np.ndarray, radius: float) -> np.ndarray:
    """Return viser's [N, 8] uint32: means, padding, the lower triangular root of the covariance as float16, RGBA."""
    means = ((values.means - middle) / radius).astype("<f4")
    roots = _covariance_roots(values.quats, np.exp(values.log_scales) / radius).astype("<f2")
    colors = values.sh_dc * SH_C0 + 0.5
    rgba = np.rint(255.0 * np.column_stack([colors, values.opacities]).clip(0, 1)).astype(np.uint8)
    gap = np.zeros((len(values), 4), np.uint8)
    parts = [means.view(np.uint8), gap, np.ascontiguousarray(roots).view(np.uint8), rgba]
    return np.concatenate([part.reshape(len(values), -1) for part in parts], axis=1).view("<u4")


def _covariance_roots(quats: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """Return L of R diag(s^2) R^T = L L^T, column by column, [N, 6]; by a QR decomposition, as the discs are flat."""
    rotations = rotation_from_quat(torch.from_numpy(quats)).numpy()
    upper = np.asarray(np.linalg.qr((rotations * scales[:, None, :]).swapaxes(1, 2), mode="r"))
    return upper[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]


def web_page(title: str, scene: bytes) -> str:
    """Return the page of a recording."""
    script, style = _viewer()
    files = {_SCENE: scene, _SKY: _DARK}
    held = ", ".join(f'"{name}": "{_data_url(content, "application/octet-stream")}"' for name, content in files.items())
    # The viewer fetches two files beside its page; a page opened from a disk has no files beside it.
    fetch = (
        f"const held = {{{held}}}; const outer = window.fetch;"
        "window.fetch = (what, how) => { const address = String(what.url ?? what);"
        "const name = Object.keys(held).find((name) => address.endsWith(name));"
        "return name ? outer(held[name]) : outer(what, how); };"
    )
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta name="generator" content="beags">\n'
        f"<title>{html.escape(title)}</title>\n<style>{style}</style>\n</head>\n<body>\n"
        '<div id="root"></div>\n<noscript>This page draws its object with JavaScript.</noscript>\n'
        f'<script>{fetch}</script>\n<script type="module">{script}</script>\n</body>\n</html>\n'
    )


def _viewer() -> tuple[str, str]:
    """Return the script and style sheet of viser's viewer, with all files that they load inside.

    Raises ``ImportError`` without viser, ``UserError`` if its viewer is not built as that of 0.2.7.
    """
    import viser

    folder = Path(viser.__file__).parent / "client" / "build" / "assets"
    scripts, styles = sorted(folder.glob("index-*.js")), sorted(folder.glob("index-*.css"))
    if len(scripts) != 1 or len(styles) != 1:
        raise UserError(f"the viewer of viser {version('viser')} does not fit into one page")
    script = scripts[0].read_text("utf8")
    binaries = {f"/assets/{path.name}": path.read_bytes() for path in folder.glob("*.wasm")}
    for path in sorted(folder.glob("*Worker-*.js")):
        worker = path.read_text("utf8")
        for address, content in binaries.items():
            worker = worker.replace(address, _data_url(content, "application/wasm"))
        script = script.replace(f"/assets/{path.name}", _data_url(worker.encode(), "text/javascript"))
    if "/assets/" in script or script.count(_START) != 1 or _SKY not in script:
        raise UserError(f"the viewer of viser {version('viser')} does not fit into one page")
    script = script.replace(_START, f'{_START}??"{_SCENE}"').replace("</script", r"<\/script")
    style = re.sub(r"@font-face\s*{[^}]*}", "", styles[0].read_text("utf8"))  # Fonts are files.
    return script, style


def _data_url(content: bytes, kind: str) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def _three(vector: np.ndarray) -> tuple[float, float, float]:
    x, y, z = vector.tolist()
    return x, y, z
