"""Writers of films: .mp4 by PyAV, .gif by Pillow."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from beags_plugin.splat_io.files import whole_file
from beags_plugin.system.errors import UserError

FILMS = (".mp4", ".gif")
_ENCODERS = ("libx264", "h264", "mpeg4")  # best first; browsers do not read the last one
REPAIR = "pip install --force-reinstall av"


def encoder() -> str | None:
    """Return the name of an installed encoder for .mp4 films; None without any."""
    try:
        import av
    except ImportError:
        return None
    for name in _ENCODERS:
        try:
            av.codec.Codec(name, "w")  # type: ignore[attr-defined]
        except ValueError:  # av's error for an unknown codec is a ValueError
            continue
        return name
    return None


def check_film(path: Path) -> None:
    """Raise ``UserError`` if a film of this name cannot be written here."""
    if path.suffix.lower() not in FILMS:
        raise UserError(f"the film {path} is no .mp4 or .gif: give it such a name.")
    if path.suffix.lower() == ".mp4" and encoder() is None:
        raise UserError(f"no codec for .mp4 is here: run {REPAIR}, or give the film a name that ends in .gif.")


def write_film(path: str | Path, frames: Iterable[np.ndarray], fps: int) -> None:
    """Write frames [H, W, 3] uint8 of one even size; raises ``UserError`` if the file cannot be written."""
    path = Path(path)
    check_film(path)
    with whole_file(path) as part:
        if path.suffix.lower() == ".gif":
            _write_gif(part, frames, fps)
        else:
            _write_mp4(part, frames, fps)


def _write_mp4(part: Path, frames: Iterable[np.ndarray], fps: int) -> None:
    import av

    name = encoder()
    assert name is not None  # check_film has checked it
    with av.open(str(part), "w", format="mp4", options={"movflags": "faststart"}) as container:
        stream: Any = None
        for frame in frames:
            if stream is None:
                stream = container.add_stream(name, rate=Fraction(fps))
                stream.height, stream.width = frame.shape[:2]
                stream.pix_fmt = "yuv420p"  # every player reads this format
                if name == "libx264":
                    stream.options = {"crf": "18"}
                else:
                    stream.bit_rate = 8_000_000
            for packet in stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24")):
                container.mux(packet)
        for packet in stream.encode():
            container.mux(packet)


def _write_gif(part: Path, frames: Iterable[np.ndarray], fps: int) -> None:
    from PIL import Image

    pictures = [Image.fromarray(frame) for frame in frames]
    pictures[0].save(part, format="GIF", save_all=True, append_images=pictures[1:], duration=round(1000 / fps), loop=0)
