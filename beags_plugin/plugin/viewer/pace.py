"""Size of the viewer's pictures while the camera moves."""

from __future__ import annotations

from collections import defaultdict, deque
from statistics import median

SECONDS = 0.055  # for rendering one picture; with what nerfstudio does to send it, more than 15 come in a second
_HEIGHT = 256  # of the first pictures; each level has twice the pixels of the one below
_GUESS = 1.3  # times the work of a level, for the one above, as long as it is not known
_WORTH = 0.7  # at most this much of a level's work makes the one below worth its coarser pictures
_LEAST, _KEPT = 5, 8  # pictures of a level: before the next choice, and remembered


class Pace:
    """Chooses the largest size that can be rendered in ``SECONDS``.

    Nerfstudio's own choice takes the seconds for proportional to the pixels. A scene of many Gaussians takes most of
    them for projecting and sorting, whatever the size: pictures then get smaller and smaller and no quicker. Here they
    get smaller only if that pays, judged by the processor's time, which other programs disturb little.
    """

    def __init__(self) -> None:
        self._level = 0
        self._pixels = 0
        self._gaussians = 0
        self._work: dict[int, deque[float]] = defaultdict(lambda: deque(maxlen=_KEPT))
        self._seconds: dict[int, deque[float]] = defaultdict(lambda: deque(maxlen=_KEPT))

    def took(self, pixels: int, gaussians: int, seconds: float, work: float) -> None:
        """Take the time of a picture, if it is of the size that was chosen. work: of the processor, all cores."""
        if gaussians != self._gaussians:
            self._gaussians = gaussians
            self._work.clear()
        if pixels == self._pixels:
            self._work[self._level].append(work)
            self._seconds[self._level].append(seconds)
            if len(self._work[self._level]) >= _LEAST:
                self._level = self._next(self._level)

    def _next(self, level: int) -> int:
        work = {of: min(kept) for of, kept in self._work.items()}
        here, below, above = work[level], work.get(level - 1, 0.0), work.get(level + 1)
        seconds = median(self._seconds[level])
        if above is not None and here > _WORTH * above:
            return level + 1
        if seconds > SECONDS:
            return level - 1 if below <= _WORTH * here else level
        return level + 1 if seconds * (_GUESS if above is None else above / max(here, 1e-9)) < SECONDS else level

    def size(self, aspect: float, longest: int) -> tuple[int, int]:
        """Return (height, width) of the next picture. aspect: width over height. longest: the most of either side."""
        most = min(longest, int(longest / aspect))
        while self._level > 0 and _HEIGHT * 2 ** (self._level / 2 - 0.5) >= most:
            self._level -= 1  # the one below is as large as may be
        height = max(min(int(_HEIGHT * 2 ** (self._level / 2)), most), 30)
        width = max(1, int(height * aspect))
        self._pixels = height * width
        return height, width
