"""Nothing outlives the program that started it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from beags_plugin.system.child_processes import bound

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="other systems do not end children with their parent")

WAIT = "import time; print('here', flush=True); time.sleep(300)"
PARENT = """
import subprocess, sys, time
from beags_plugin.system.child_processes import bound
child = subprocess.Popen(bound([sys.executable, "-c", {wait!r}], {kind}), stdout=subprocess.PIPE)
child.stdout.readline()
print(child.pid, flush=True)
time.sleep(300)
"""


def has_ended(pid: int, seconds: float = 120.0) -> bool:
    """Return whether a process is gone or a zombie before the time is over."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        try:
            state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
        except FileNotFoundError:
            return True
        if state == "Z":
            return True
        time.sleep(0.02)
    return False


@pytest.mark.parametrize("kind", [signal.SIGTERM, signal.SIGKILL])
def test_a_process_ends_with_one_that_is_killed(kind):
    code = PARENT.format(wait=WAIT, kind=int(kind))
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as parent:
        child = int(parent.stdout.readline())
        try:
            assert not has_ended(child, 0.3)
            parent.kill()
            parent.wait()
            assert has_ended(child)
        finally:
            parent.kill()
            if not has_ended(child, 0.0):
                os.kill(child, signal.SIGKILL)


def test_a_command_is_itself_but_for_that():
    words = ["-c", "import sys; print(sys.argv[1:], sys.stdin.read()); sys.exit(7)", "a b", "$c", ""]
    done = subprocess.run(bound([sys.executable, *words]), input="given", capture_output=True, text=True)
    assert done.returncode == 7 and done.stdout == "['a b', '$c', ''] given\n"


def test_a_command_whose_parent_is_gone_already_does_not_begin(tmp_path):
    command = bound(["touch", tmp_path / "begun"])
    command[command.index(str(os.getpid()))] = "999999999"
    assert subprocess.run(command).returncode == -signal.SIGTERM
    assert not (tmp_path / "begun").exists()
