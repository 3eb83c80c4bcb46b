"""Early ends of a training: Ctrl-C and SIGTERM, after the step is finished and saved; user errors."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable
from types import FrameType
from typing import Any, NoReturn

from rich import get_console
from rich.markup import escape

from beags_plugin.system.errors import UserError

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Interrupts:
    """Notes the first signal for the training loop to ask about; a second one ends the program at once.

    at_once: let the first signal end the program too, as where no step could be finished. wake: called at the first
    signal, so that a loop that waits looks at ``asked``.
    """

    def __init__(self, wake: Callable[[], None] = lambda: None) -> None:
        self._wake = wake
        self.asked: int | None = None
        self.at_once = False
        self._former: dict[signal.Signals, Any] = {}

    def __enter__(self) -> Interrupts:
        if threading.current_thread() is threading.main_thread():  # Python allows it there alone
            self._former = {number: signal.signal(number, self._note) for number in SIGNALS}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._former.items():
            signal.signal(number, handler)
        self._former = {}

    def _note(self, number: int, _: FrameType | None) -> None:
        again, self.asked = self.asked is not None, number
        if again or self.at_once:
            raise KeyboardInterrupt
        get_console().print("Stopping after this step, and saving it. Once more ends at once.", highlight=False)
        self._wake()

    @property
    def exit_code(self) -> int:
        """Return the exit code that a shell expects of a program that a signal ended."""
        return 128 + (self.asked or signal.SIGINT)


def stop(error: UserError) -> NoReturn:
    """End the program with the sentence of a user's error, and exit code 2."""
    get_console().print(f"[bold red]beags:[/bold red] {escape(str(error))}", highlight=False, soft_wrap=True)
    error.reported = True
    raise SystemExit(2) from error  # the cause is for callers from Python
