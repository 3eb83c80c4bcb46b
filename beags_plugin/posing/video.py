"""Choice of the frames of a video to find poses for: the sharpest ones, at even distances of motion."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from beags_plugin.posing.photos import FEWEST, Look, look_at
from beags_plugin.system.digests import content_digest
from beags_plugin.system.errors import UserError
from beags_plugin.system.progress import Bar, counted
from beags_plugin.system.reading.stand_ins import stand_in
from beags_plugin.system.whole_files import write_text_atomically, write_whole

VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm")
RECORD = "frames.json"  # file beside the frames that names their video
MOST = 150  # frames that are chosen
STEP = 0.03
"""Least motion between chosen frames, as a share of the picture's longest side."""
_POINTS = 200  # points of a frame that are followed into the next


def is_video(data: Path) -> bool:
    """Return whether ``data`` is a video, by its name; raises ``UserError`` for other files."""
    if data.is_file() and data.suffix.lower() not in VIDEO_SUFFIXES:
        raise UserError(
            f"{data} is no video that is known by its name ({', '.join(VIDEO_SUFFIXES)}): give a folder of photos."
        )
    return data.is_file()


def find_frames(video: Path, folder: Path, bar: Bar) -> list[Path]:
    """Return the files in ``folder`` for the chosen frames; ``write_frames`` writes them.

    Raises ``UserError`` for a video that cannot be read or hardly moves.
    """
    if (record := _record(folder)).get("video") == content_digest([video]):
        return [folder / name for name in record["frames"]]
    with bar("looking at frames") as progress, _frames(video) as (frames, total):
        sharpness, motions = [], []
        before: Look | None = None
        for index, frame in enumerate(frames):
            look = look_at(frame.to_ndarray(format="gray"))
            motions.append(_motion(before, look) if before else 0.0)
            sharpness.append(look.sharpness)
            before = look
            progress(index + 1, max(total, index + 1))
    chosen = choose_frames(np.array(motions), np.array(sharpness))
    if len(chosen) < FEWEST:
        raise UserError(
            f"the video {video} has too few frames that show the scene from different places ({len(chosen)} of "
            f"{len(motions)}): film while walking around it."
        )
    return [folder / f"frame_{index + 1:05d}.jpg" for index in chosen]


def write_frames(video: Path, files: Sequence[Path], bar: Bar) -> None:
    """Write the frames that ``find_frames`` named as JPEGs, unless they are there."""
    folder = files[0].parent
    content = {"video": content_digest([video]), "frames": [file.name for file in files]}
    if _record(folder) == content and all(file.is_file() for file in files):
        return
    (folder / RECORD).unlink(missing_ok=True)
    numbered = {int(file.stem[-5:]): file for file in files}
    with bar("frames") as progress, _frames(video) as (frames, _):
        wanted = ((numbered[number], frame) for number, frame in enumerate(frames, start=1) if number in numbered)
        for file, frame in counted(wanted, len(files), progress):
            _write(file, frame)
    write_text_atomically(json.dumps(content) + "\n", folder / RECORD)


def _record(folder: Path) -> dict[str, Any]:
    try:
        return json.loads((folder / RECORD).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}


def choose_frames(motions: np.ndarray, sharpness: np.ndarray) -> list[int]:
    """Return the sharpest frame of each stretch of equal motion, in order.

    motions: motion of each frame since the one before, in longest sides. Stretches are at least ``STEP`` long.
    """
    way = np.cumsum(motions)
    if len(way) == 0:
        return []
    step = max(STEP, way[-1] / MOST)
    stretch = np.minimum(way // step, MOST - 1)
    return [
        int(part[np.argmax(sharpness[part])]) for part in (np.flatnonzero(stretch == s) for s in np.unique(stretch))
    ]


def _motion(before: Look, now: Look) -> float:
    """Return the median distance that the corners of a small picture move, in longest sides."""
    import cv2

    corners = cv2.goodFeaturesToTrack(before.small, _POINTS, 0.01, 5)
    if corners is None:
        return 0.0
    moved, tracked, _ = cv2.calcOpticalFlowPyrLK(before.small, now.small, corners, np.empty_like(corners))
    ways = np.linalg.norm(moved - corners, axis=-1)[tracked == 1]
    return float(np.median(ways)) / max(now.small.shape) if len(ways) else 0.0


@contextmanager
def _frames(video: Path) -> Iterator[tuple[Iterator[Any], int]]:
    """Open a video; yields its frames and how many there may be."""
    import av
    import av.error

    try:
        with av.open(str(video)) as container:
            stream = container.streams.video[0]
            stream.thread_type = "AUTO"
            yield container.decode(stream), stream.frames
    except (av.error.FFmpegError, IndexError) as error:
        if (cause := stand_in(video)) is not None:
            raise UserError(f"the video {video} cannot be read: {cause}.") from error
        raise UserError(f"the video {video} cannot be read ({error}): convert it to an .mp4 of H.264.") from error


def _write(path: Path, frame: Any) -> None:
    from PIL import Image

    turns = round(getattr(frame, "rotation", 0) / 90) % 4
    image = Image.fromarray(np.rot90(frame.to_ndarray(format="rgb24"), turns).copy())
    write_whole(path, lambda file: image.save(file, "JPEG", quality=95))
