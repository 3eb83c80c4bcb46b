"""Size of the viewer's pictures while the camera moves."""

from __future__ import annotations

from collections import defaultdict, deque
from statistics import median

SECONDS = 0.055  # Time to render one picture; with nerfstudio's time to send it, more than 15 arrive in a second.
_HEIGHT = 256  # Height of the first pictures; each level has twice the pixels of the one below.
_GUESS = 1.3  # Guessed work of the level above, in units of the present level's, until it is measured.
_WORTH = 0.7  # The level below is chosen only if it has at most this share of the present level's work.
_LEAST, _KEPT = 5, 8  # Pictures of a level before the next choice, and pictures remembered.


class Pace:
    """Chooses the largest size that can be rendered in ``SECONDS``.

    Nerfstudio assumes that time is proportional to pixels. With many Gaussians, projecting and sorting take most of the
    time at any size, so its pictures get smaller and smaller but no quicker. Here they get smaller only if that saves
    enough processor time, which other programs disturb little.
    """

    def __init__(self) -> None:
        self._level = 0
        self._pixels = 0
        self._gaussians = 0
        self._work: dict[int, deque[float]] = defaultdict(lambda: deque(maxlen=_KEPT))
        self._seconds: dict[int, deque[float]] = defaultdict(lambda: deque(maxlen=_KEPT))

    def took(self, pixels: int, gaussians: int, seconds: float, work: float) -> None:
        """Record the time of a picture if it has the chosen size. work: processor time of all cores, seconds."""
        if gaussians != self._gaussians:
            self._gaussians = gaussians
            self._work.clear()
        if pixels == self._pixels:
            self._work[self._level].append(work)
            self._seconds[self._level].append(seconds)
            if len(self._work[self._level]) >= _LEAST:
                self._level = self._next(self._level)

    def _next(self, level: int) -> int:
        work = {each: min(times) for each, times in self._work.items()}
        here, below, above = work[level], work.get(level - 1, 0.0), work.get(level + 1)
        seconds = median(self._seconds[level])
        if above is not None and here > _WORTH * above:
            return level + 1
        if seconds > SECONDS:
            return level - 1 if below <= _WORTH * here else level
        return level + 1 if seconds * (_GUESS if above is None else above / max(here, 1e-9)) < SECONDS else level

    def size(self, aspect: float, longest: int) -> tuple[int, int]:
        """Return (height, width) of the next picture. aspect: width over height. longest: most pixels of a side."""
        most = min(longest, int(longest / aspect))
        while self._level > 0 and _HEIGHT * 2 ** (self._level / 2 - 0.5) >= most:
            self._level -= 1  # The level below already fills the largest size.
        height = max(min(int(_HEIGHT * 2 ** (self._level / 2)), most), 30)
        width = max(1, int(height * aspect))
        self._pixels = height * width
        return height, width
