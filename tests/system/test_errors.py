"""A user error prints one sentence, also in programs of others."""

from __future__ import annotations

import errno
import os
import subprocess
import sys

import pytest
import torch

from beags_plugin.system.errors import UserError, writing

PROGRAM = """
from beags_plugin.system.errors import UserError, print_user_errors_plainly
print_user_errors_plainly()
raise {error}
"""


def _run(error: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", PROGRAM.format(error=error)], capture_output=True, text=True)


def test_a_user_error_prints_its_sentence_alone():
    done = _run("UserError('masks/a.png is no image: replace it.')")
    assert done.returncode == 2
    assert done.stderr.strip() == "beags: masks/a.png is no image: replace it."


def test_other_errors_keep_their_traceback():
    done = _run("ValueError('a defect')")
    assert done.returncode != 0
    assert "Traceback" in done.stderr and "ValueError: a defect" in done.stderr


CURVES = """
import errno, sys, threading
from beags_plugin.system.errors import print_user_errors_plainly
from tensorboard.summary.writer.event_file_writer import EventFileWriter
from tensorboard.summary.writer.record_writer import RecordWriter

print_user_errors_plainly()

def refuse(*_):
    raise {error}

RecordWriter.write = refuse
try:
    EventFileWriter(sys.argv[1])
except OSError:
    print("handed on")
for thread in threading.enumerate():  # it prints only afterwards
    if thread is not threading.main_thread():
        thread.join(30)
"""


@pytest.mark.parametrize("code, silent", [("ENOSPC", True), ("EBADF", False)])
def test_a_full_disk_under_curves_prints_no_traceback_of_their_thread(tmp_path, code, silent):
    program = CURVES.format(error=f"OSError(errno.{code}, 'refused')")
    done = subprocess.run([sys.executable, "-c", program, tmp_path], capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout == "handed on\n"
    assert ("Traceback" not in done.stderr) == silent


def error_in(path, cause: BaseException) -> BaseException:
    """Return the error that leaves a block which writes ``path`` and raises ``cause``."""
    with pytest.raises(BaseException) as raised, writing(path):
        raise cause
    return raised.value


def refusal(code: int, *file) -> OSError:
    return OSError(code, os.strerror(code), *map(str, file))


@pytest.mark.parametrize(
    "code", [errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS, errno.EACCES, errno.EPERM]
)
def test_what_a_disk_refuses_is_reported_with_the_path(tmp_path, code):
    error = error_in(tmp_path / "a.png", refusal(code))
    assert isinstance(error, UserError) and f"{tmp_path}/a.png cannot be written ({os.strerror(code)})" in str(error)
    part = refusal(code, tmp_path / ".a.png.part")
    assert isinstance(error_in(tmp_path / "a.png", part), UserError)


def test_mistakes_in_the_program_blame_no_path(tmp_path):
    """Some are of the system's kind too: a closed pipe, a closed file, a picture that cannot be saved."""
    pipe, closed = refusal(errno.EPIPE), refusal(errno.EBADF)
    for cause in (KeyError("x"), pipe, closed, OSError("cannot write mode F as PNG"), refusal(errno.EINVAL)):
        assert error_in(tmp_path / "a.png", cause) is cause
    elsewhere = refusal(errno.ENOENT, "/nowhere/photo.png")
    assert error_in(tmp_path / "a.png", elsewhere) is elsewhere


def test_a_mistake_made_while_a_refusal_is_handled_is_a_mistake(tmp_path):
    with pytest.raises(KeyError), writing(tmp_path / "a.png"):
        try:
            raise refusal(errno.EACCES, tmp_path / "a.png")
        except OSError:
            {}["missing"]
    with pytest.raises(UserError, match="cannot be written"), writing(tmp_path / "a.png"):
        try:
            raise refusal(errno.EACCES, tmp_path / "a.png")
        except OSError as error:
            raise ValueError("the library's own kind") from error


def test_what_torch_makes_of_a_full_disk_is_known(tmp_path):
    if not os.path.exists("/dev/full"):
        pytest.skip("this system has no /dev/full")
    with (
        pytest.raises(UserError, match=os.strerror(errno.ENOSPC)),
        writing(tmp_path / "a.pt"),
        open("/dev/full", "wb", buffering=0) as file,
    ):
        torch.save({"a": torch.zeros(100_000)}, file)
