"""Early ends of a training: after Ctrl-C or SIGTERM, once the step is finished and saved, and after user errors."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable
from types import FrameType
from typing import Any, NoReturn

from rich import get_console
from rich.markup import escape

from beags_plugin.system.errors import UserError


class Interrupts:
    """Records the first signal in ``signal``, which the training loop reads; a second one ends the program at once.

    at_once: let the first signal end the program too, where no step is running. wake: called at the first signal, so
    that a waiting loop reads ``signal``.
    """

    def __init__(self, wake: Callable[[], None]) -> None:
        self._wake = wake
        self.signal: int | None = None
        self.at_once = False
        self._former: dict[signal.Signals, Any] = {}

    def __enter__(self) -> Interrupts:
        if threading.current_thread() is threading.main_thread():  # Python sets handlers in this thread only
            self._former = {number: signal.signal(number, self._note) for number in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._former.items():
            signal.signal(number, handler)
        self._former = {}

    def _note(self, number: int, _: FrameType | None) -> None:
        again, self.signal = self.signal is not None, number
        if again or self.at_once:
            raise KeyboardInterrupt
        get_console().print("Stopping after this step, and saving it. Once more ends at once.", highlight=False)
        self._wake()

    @property
    def exit_code(self) -> int:
        """Return the exit code that a shell expects of a program that a signal ended."""
        return 128 + (self.signal or signal.SIGINT)


def stop(error: UserError) -> NoReturn:
    """Print the sentence of a user error and end the program with exit code 2."""
    get_console().print(f"[bold red]beags:[/bold red] {escape(str(error))}", highlight=False, soft_wrap=True)
    error.reported = True
    raise SystemExit(2) from error  # callers from Python read the cause
