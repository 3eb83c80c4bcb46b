"""A user's mistake is told in one sentence, also in programs that are not ours."""

from __future__ import annotations

import subprocess
import sys

PROGRAM = """
import beags_plugin.plugin
from beags_plugin.errors import UserError, print_user_errors_plainly
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
