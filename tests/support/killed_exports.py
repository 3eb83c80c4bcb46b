"""Exports that end by SIGKILL while they write their second file: a program of test_broken_off_exports.py (Linux).

Arguments: config.yml of a run, a folder, and formats; each format's files go to a folder of its name.
"""

from __future__ import annotations

import signal
import sys
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parents[1] / "soak"))
import forked
import kill_test

OPTIONS = ("--all", "--scale-by", "0,0,0 1,0,0 1 m", "--resolution", "16", "--min-views", "1")


def export(config: Path, folder: Path, format_name: str) -> None:
    from beags_plugin.commands.cli import main

    options = ("--load-config", str(config), "--output", str(folder), "--format", format_name)
    main(["export", *options, *OPTIONS])


def killed(config: Path, folder: Path, format_name: str) -> None:
    with forked.killed_in_write("", 2, 1.1):
        export(config, folder, format_name)


def main(config: str, folder: str, *formats: str) -> None:
    kill_test.import_everything()
    for name in formats:
        log, files = Path(folder) / f"{name}.log", Path(folder) / name
        code = forked.run(lambda name=name, files=files: killed(Path(config), files, name), log)
        if code != -signal.SIGKILL:
            raise RuntimeError(f"the export as {name} ended by itself with exit code {code}: {log.read_text()}")


if __name__ == "__main__":
    main(*sys.argv[1:])
