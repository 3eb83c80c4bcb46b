"""Write the table of options into README.md: ``python baselines/page.py``. It comes from the refiners' dataclasses."""

from __future__ import annotations

import inspect
import re
from ast import AnnAssign, ClassDef, Constant, Expr, parse
from collections.abc import Iterator
from dataclasses import fields
from importlib.metadata import entry_points
from pathlib import Path

PAGE = Path(__file__).resolve().parent / "README.md"
MARKS = "<!-- options -->\n", "<!-- end of options -->\n"


def described(kind: type) -> Iterator[tuple[str, str, str]]:
    """Yield name, default and description of each option; raises ``ValueError`` for a field without a docstring."""
    (tree,) = parse(inspect.getsource(kind)).body
    assert isinstance(tree, ClassDef)
    texts = {}
    for field, after in zip(tree.body, tree.body[1:], strict=False):
        if isinstance(field, AnnAssign) and isinstance(after, Expr) and isinstance(after.value, Constant):
            texts[field.target.id] = " ".join(str(after.value.value).split())  # pyright: ignore[reportAttributeAccessIssue]
    for field in fields(kind):
        if field.name not in texts:
            raise ValueError(f"{kind.__name__}.{field.name} has no docstring")
        yield field.name, f"{field.default}" if field.default != "" else "empty", texts[field.name].removesuffix(".")


def table() -> str:
    """Return a table of the options of all refiners of this distribution, one a row."""
    rows = ["| refiner | option | default | |", "|---|---|---|---|"]
    points = [point for point in entry_points(group="beags.refiners") if point.value.startswith("beags_baselines.")]
    for point in sorted(points):
        for place, (option, default, text) in enumerate(described(point.load())):
            rows.append(f"| {f'`{point.name}`' if place == 0 else ''} | `{option}` | {default} | {text} |")
    return "\n".join(rows) + "\n"


def page(text: str) -> str:
    """Return the page with the table between its marks."""
    before, after = MARKS
    return re.sub(f"(?<={before}).*?(?={after})", lambda _: f"\n{table()}\n", text, flags=re.DOTALL)


if __name__ == "__main__":
    PAGE.write_text(page(PAGE.read_text("utf8")), "utf8")
