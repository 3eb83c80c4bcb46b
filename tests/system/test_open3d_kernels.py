"""Open3D's kernels load without the rest of its package, which can still be imported later."""

from __future__ import annotations

import subprocess
import sys

import pytest

pytest.importorskip("open3d")

CODE = """
import sys
from beags_plugin.system.open3d_kernels import open3d_kernels
found = open3d_kernels()
assert not {"sklearn", "dash", "open3d"} & set(sys.modules), "the whole package is loaded"
assert found is open3d_kernels()
import open3d
assert open3d.geometry.TriangleMesh is found.geometry.TriangleMesh
assert open3d_kernels().t.geometry.RaycastingScene is open3d.t.geometry.RaycastingScene
"""


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere the whole package is loaded")
def test_the_kernels_load_alone():
    done = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_where_it_is_missing_that_is_an_import_error(monkeypatch):
    from beags_plugin.system.open3d_kernels import open3d_kernels

    open3d_kernels()
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(ImportError):
        open3d_kernels()
