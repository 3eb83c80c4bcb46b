"""Closed meshes for printers, in millimetres: .stl and .3mf."""

from __future__ import annotations

import hashlib
import io
import re
import uuid
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from beags_plugin.export.mesh import MeshExporter
from beags_plugin.splat_io.files import write_bytes
from beags_plugin.surfaces.item import ExportItem

MILLIMETRES = 1000.0  # millimetres per metre


@dataclass(frozen=True)
class PrintExporter(MeshExporter):
    """A closed surface in millimetres, z up, written by trimesh."""

    needs_metres: ClassVar[bool] = True
    closes: ClassVar[bool] = True

    @classmethod
    def unavailable(cls) -> str | None:
        try:
            import lxml  # noqa: F401
            import networkx  # noqa: F401
            import trimesh  # noqa: F401
        except ImportError as error:
            return f"trimesh or a library it needs cannot be loaded ({error}); pip install trimesh lxml networkx."
        return super().unavailable()

    def write(self, path: Path, item: ExportItem) -> dict[str, Any]:
        import trimesh

        made = self.made(item)
        solid = trimesh.Trimesh(MILLIMETRES * made.mesh.vertices, made.mesh.faces, process=False)
        content: Any = trimesh.Scene({item.name: solid}).export(file_type=self.suffix)
        write_bytes(path, self.repeatable(content))
        sides = solid.extents.round(2).tolist()
        return made.facts() | {"unit": "millimetre", "sides": sides, "watertight": bool(solid.is_watertight)}

    @classmethod
    def repeatable(cls, content: bytes) -> bytes:
        """Return the file's content with trimesh's random parts replaced."""
        return content


@dataclass(frozen=True)
class StlExporter(PrintExporter):
    """Binary .stl, which states no unit; slicers assume millimetres."""

    suffix: ClassVar[str] = "stl"


@dataclass(frozen=True)
class ThreeMfExporter(PrintExporter):
    """3D Manufacturing Format, which states its unit."""

    suffix: ClassVar[str] = "3mf"

    @classmethod
    def repeatable(cls, content: bytes) -> bytes:
        """Return the archive with UUIDs that follow from its content instead of trimesh's random ones."""
        made = io.BytesIO()
        with zipfile.ZipFile(io.BytesIO(content)) as read, zipfile.ZipFile(made, "w") as written:
            for entry in read.infolist():
                written.writestr(entry, _with_own_uuids(read.read(entry)))
        return made.getvalue()


def _with_own_uuids(text: bytes) -> bytes:
    """Return XML whose n-th UUID is a hash of n and the rest of the text."""
    first, *others = re.split(rb'(?<=:UUID=")[0-9a-f-]{36}(?=")', text)
    rest = hashlib.sha256(b"".join([first, *others])).hexdigest()
    uuids = (str(uuid.uuid5(uuid.NAMESPACE_OID, f"{rest} {order}")).encode() for order in range(len(others)))
    return first + b"".join(own + other for own, other in zip(uuids, others, strict=True))
