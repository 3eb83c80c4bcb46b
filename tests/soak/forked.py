"""Commands in forked processes, which need not import everything again, and their end by SIGKILL (Linux)."""

from __future__ import annotations

import io
import itertools
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, BinaryIO
from unittest import mock

from beags_plugin.system import whole_files
from beags_plugin.system.child_processes import end_with_parent


def forked(call: Callable[[], object], log: Path) -> int:
    """Start ``call`` in a process of its own, which prints to ``log``; returns its process id.

    It ends with exit code 0 if the call returns, 1 if it raises, or the code that it asks for. This process must not
    have computed anything: threads do not survive a fork.
    """
    parent = os.getpid()
    child = os.fork()
    if child > 0:
        return child
    code = 1
    try:
        end_with_parent(signal.SIGKILL, parent)
        with open(log, "ab") as out, open(os.devnull) as nothing:
            for target, source in ((0, nothing), (1, out), (2, out)):
                os.dup2(source.fileno(), target)
        call()
        code = 0
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:  # an interrupt too must not go on in the loop of the parent
        os.write(2, traceback.format_exc().encode())
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def ended(child: int) -> int | None:
    """Return the exit code of a child, negative for a signal; None while it runs. Call it once after the end."""
    found, status = os.waitpid(child, os.WNOHANG)
    return os.waitstatus_to_exitcode(status) if found else None


def run(call: Callable[[], object], log: Path) -> int:
    """Start ``call`` and wait for its end; returns its exit code."""
    return os.waitstatus_to_exitcode(os.waitpid(forked(call, log), 0)[1])


def kill_after(call: Callable[[], object], log: Path, cpu_seconds: float) -> tuple[int, float]:
    """Start ``call`` and kill it after some CPU time; return its exit code (-9: killed) and CPU time."""
    child, used = forked(call, log), 0.0
    while (code := ended(child)) is None:
        used = max(used, cpu_time(child))
        if used < cpu_seconds:
            time.sleep(0.002)
        else:
            os.kill(child, signal.SIGKILL)
            return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), used
    return code, used


def cpu_time(child: int) -> float:
    """Return the seconds of CPU time that a process has had: a moment in a run, however busy the machine is."""
    try:
        fields = Path(f"/proc/{child}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


@contextmanager
def killed_in_call(owner: type, name: str, number: int, seconds: float) -> Iterator[None]:
    """Let this process end by SIGKILL some seconds after the ``number``-th call, from 1, of a method begins."""
    method, calls = getattr(owner, name), itertools.count(1)

    def called(*args: Any, **options: Any) -> Any:
        if next(calls) == number:
            threading.Timer(seconds, os.kill, (os.getpid(), signal.SIGKILL)).start()
        return method(*args, **options)

    with mock.patch.object(owner, name, called):
        yield


@contextmanager
def killed_in_write(ends: str, number: int, share: float) -> Iterator[None]:
    """Let this process end by SIGKILL while it writes a file whose name ends so: the ``number``-th, from 1.

    share: 0 to 1 of the bytes that the file before it had, after which it ends; beyond 1, in the first file, and in
    files that another library writes: once all is written, before the file is put in its place.
    """
    seen, last, writing = 0, 0, False
    write_whole, put_in_place = whole_files.write_whole, whole_files.put_in_place

    def write(path: Path, content: Callable[[BinaryIO], object], beside: Path | None = None) -> None:
        nonlocal seen, last, writing
        if not path.name.endswith(ends):
            return write_whole(path, content, beside)
        seen += 1
        most = int(share * last) if seen == number and last and share < 1.0 else None

        def counted(file: BinaryIO) -> None:
            nonlocal last
            ending = _Ending(file, most)
            content(ending)  # type: ignore[arg-type]
            last = ending.tell()

        writing = True
        try:
            write_whole(path, counted, beside)
        finally:
            writing = False

    def put(part: Path, path: Path) -> None:
        nonlocal seen
        if path.name.endswith(ends):
            seen += not writing
            if seen == number:
                os.kill(os.getpid(), signal.SIGKILL)
        put_in_place(part, path)

    with ExitStack() as patches:
        for name, former, new in (("write_whole", write_whole, write), ("put_in_place", put_in_place, put)):
            for module in [module for module in list(sys.modules.values()) if getattr(module, name, None) is former]:
                patches.enter_context(mock.patch.object(module, name, new))
        yield


class _Ending(io.RawIOBase):
    """A file that ends the process once ``most`` bytes are in it, unless that is None."""

    def __init__(self, file: BinaryIO, most: int | None) -> None:
        self._file, self._most = file, most

    def write(self, content: Any) -> int:
        if self._most is not None and self._file.tell() + memoryview(content).nbytes > self._most:
            self._file.write(memoryview(content).cast("B")[: max(self._most - self._file.tell(), 0)])
            self._file.flush()
            os.kill(os.getpid(), signal.SIGKILL)
        return self._file.write(content)

    def writable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._file.tell()
