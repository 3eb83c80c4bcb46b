"""Messages for users who make mistakes: one sentence with the file or value and the remedy, and exit code 2.

The mistakes are in ``mistakes/``, their sentences, word for word, in ``mistakes/sentences.txt``. To write that file
anew, and then to read its changes: ``BEAGS_SENTENCES=write pytest tests/mistakes``.
"""

from __future__ import annotations

import hashlib
import os
import re
from pathlib import Path

import pytest

pytest.importorskip("nerfstudio")

from mistakes import disks, masks, options, photos, poses, runs, starts  # noqa: F401  (they fill the table)
from mistakes.sentences import read_sentences, write_sentence
from mistakes.table import TABLE, TRAINED, Place, Templates

SENTENCES = read_sentences()
RUNS = (TRAINED, "run")
"""Runs in which a command that is refused leaves nothing, unless it has saved a checkpoint."""


@pytest.fixture(scope="module")
def templates(tmp_path_factory):
    return Templates(tmp_path_factory.mktemp("templates"))


def files_below(root: Path) -> dict[Path, str]:
    """Return the digest of every file."""
    found = (path for path in root.rglob("*") if path.is_file())
    return {path: hashlib.sha256(path.read_bytes()).hexdigest() for path in found}


@pytest.mark.parametrize("name", TABLE)
def test_a_mistake_ends_with_one_sentence_and_code_2(name, templates, tmp_path, monkeypatch, capsys, recwarn):
    place = Place(tmp_path, templates, monkeypatch)
    monkeypatch.chdir(tmp_path)
    with monkeypatch.context() as patch:
        place.patch = patch
        command = TABLE[name](place)
        before, there = files_below(tmp_path), set(tmp_path.rglob("*"))
        capsys.readouterr()
        with pytest.raises(SystemExit) as end:
            command()
    printed = capsys.readouterr()
    assert end.value.code == 2
    assert "Traceback" not in printed.out + printed.err
    lines = [line for line in printed.out.splitlines() if line.startswith("beags: ")]
    assert len(lines) == 1 and printed.out.splitlines()[-1] == lines[0]
    assert len(printed.out.splitlines()) < 40  # Other output does not bury it.
    assert not [each.message for each in recwarn if each.filename.endswith(("engine/trainer.py", "utils/writer.py"))]
    sentence = lines[0].removeprefix("beags: ").replace(str(tmp_path), "{tmp}")
    sentence = re.sub(r"\.masks_\w+", ".masks_...", sentence)  # a temporary folder
    sentence = re.sub(r"tabletop-0-\w+", "tabletop-0-...", sentence)  # a digest of what is generated
    after = files_below(tmp_path)
    changed = [path for path in before if after.get(path) != before[path]]
    assert not changed  # nothing that was saved is lost
    new = {path for path in set(tmp_path.rglob("*")) - there if path.relative_to(tmp_path).parts[0] in RUNS}
    assert not new or any(path.suffix == ".ckpt" for path in new)  # no dead run
    assert not list(tmp_path.rglob("*.part")) and not (tmp_path / "ran").exists()  # a command in a foreign file
    if os.environ.get("BEAGS_SENTENCES") == "write":
        write_sentence(name, sentence, list(TABLE))
    else:
        assert sentence == SENTENCES[name]
    assert sentence.endswith(".") and len(sentence) < 500
    assert re.search(r"(: |; |\. )[A-Za-z-]", sentence)  # The sentence goes on with what to do.


def test_every_sentence_is_of_a_mistake():
    assert set(SENTENCES) == set(TABLE)
