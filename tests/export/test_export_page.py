"""One .html of an object: what is in it, and what a browser shows of it."""

from __future__ import annotations

import gzip
import io
import math
import re
from dataclasses import replace
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest
import torch
from browser import NEEDED, Page
from covered_things import camera_of, covered, thing_called
from PIL import Image
from random_surfels import camera_at, drawn, random_surfels
from run_folders import discs

pytest.importorskip("viser")

from beags_plugin.core.cameras import Camera
from beags_plugin.core.rotations import rotation_from_quat
from beags_plugin.core.sh import sh_colors
from beags_plugin.export.base import make_exporter
from beags_plugin.export.page_colors import seen_colors
from beags_plugin.export.splat_values import splat_values
from beags_plugin.export.web_page import recording, splat_buffer, web_page
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.rasterizers.interface import RasterSettings
from beags_plugin.sample.views import make_views
from beags_plugin.surfaces.frames import bounding_box
from beags_plugin.surfaces.item import ExportItem, NothingToExport, Viewpoints
from beags_plugin.system.errors import UserError

DRAWN = 215  # grey value, of 255, below which a pixel shows the object on white


def viewpoints(*cameras: Camera) -> Viewpoints:
    return Viewpoints(cameras, make_rasterizer("auto"), RasterSettings(0.05, 50.0))


@pytest.fixture(scope="module")
def cup() -> ExportItem:
    """The sample's cup, covered with small opaque discs where its views see it."""
    views = [camera_of(view) for view in make_views(2, 64, 48, 24, 1) if view.split == "train"]
    surfels = covered(thing_called("cup"), views)
    return ExportItem("cup", surfels, torch.ones(len(surfels), dtype=torch.int32), viewpoints(*views))


def messages(content: bytes) -> dict[str, dict]:
    """The messages of a recording, by type."""
    held = msgspec.msgpack.decode(gzip.decompress(content))
    assert held["durationSeconds"] == 0 and held["loopStartIndex"] is None
    return {message["type"]: message for _, message in held["messages"]}


def unpacked(buffer: np.ndarray) -> SimpleNamespace:
    """Means, covariances, colours and opacities of viser's buffer, as its shader reads them."""
    rows = np.ascontiguousarray(buffer).view(np.uint8).reshape(len(buffer), 32)
    halves = np.ascontiguousarray(rows[:, 16:28]).view("<f2").astype(float)
    roots = np.zeros((len(rows), 3, 3))
    roots[:, [0, 1, 2, 1, 2, 2], [0, 0, 0, 1, 1, 2]] = halves
    return SimpleNamespace(
        means=np.ascontiguousarray(rows[:, :12]).view("<f4"),
        covariances=roots @ roots.swapaxes(1, 2),
        colors=rows[:, 28:31] / 255,
        opacities=rows[:, 31] / 255,
    )


def test_the_buffer_holds_the_gaussians_in_a_ball_of_radius_one():
    surfels = random_surfels(count=50, degree=0)
    values = splat_values(surfels, "cup")
    middle, radius = np.array([0.1, -0.2, 0.3]), 2.5
    found = unpacked(splat_buffer(values, middle, radius))
    assert np.abs(found.means * radius + middle - values.means).max() < 1e-6
    axes = rotation_from_quat(torch.from_numpy(values.quats)).numpy() * np.exp(values.log_scales)[:, None, :]
    expected = axes @ axes.swapaxes(1, 2) / radius**2
    sizes = np.abs(expected).max(axis=(1, 2))
    assert (np.abs(found.covariances - expected).max(axis=(1, 2)) < 3e-3 * sizes).all()  # float16
    assert np.abs(found.opacities - values.opacities).max() <= 0.5 / 255 + 1e-9
    assert np.abs(found.colors - (0.5 + 0.28209479 * values.sh_dc).clip(0, 1)).max() <= 0.5 / 255 + 1e-6


def test_colours_are_those_that_the_views_see():
    """One view sees the front of a disc alone; from both sides, equally near, the mean is seen."""
    surfels = random_surfels(count=1, degree=3)
    surfels = replace(surfels, means=torch.zeros(1, 3), quats=torch.tensor([[1.0, 0, 0, 0]]))
    surfels.log_scales[:], surfels.opacity_logits[:] = -1.0, 4.0
    above, below = camera_at((0.0, 0.1, 2.0)), camera_at((0.0, 0.1, -2.0))
    as_seen = [
        sh_colors(surfels.sh_dc, surfels.sh_rest, surfels.means, view.host.center, 3)[0] for view in (above, below)
    ]
    assert (as_seen[0] - as_seen[1]).abs().max() > 0.05
    counts: list[int] = []
    one = seen_colors(surfels, viewpoints(above), counts.append)
    both = seen_colors(surfels, viewpoints(above, below), counts.append)
    assert counts == [1, 1, 2] and one.surfels.sh_degree == 0

    def color(seen) -> torch.Tensor:
        return 0.5 + 0.28209479 * seen.surfels.sh_dc[0]

    assert torch.allclose(color(one), as_seen[0], atol=1e-5)
    assert torch.allclose(color(both), (as_seen[0] + as_seen[1]) / 2, atol=0.01)
    assert np.allclose(one.eye, (0.0, 0.1, 2.0), atol=1e-5)
    hidden = seen_colors(surfels, viewpoints(camera_at((0.0, 0.0, 2.0), torch.tensor([0.0, 0.0, 4.0]))), counts.append)
    assert torch.allclose(hidden.surfels.sh_dc, surfels.sh_dc)


def test_the_camera_stands_upright_where_a_photo_was_taken(cup):
    seen = seen_colors(cup.surfels, cup.views, lambda done: None)
    found = messages(recording(cup, seen))
    eyes = [np.array(camera.host.center) for camera in cup.views.cameras]
    assert min(np.linalg.norm(seen.eye - eye) for eye in eyes) < 1e-4
    assert seen.up[2] > 0.9  # the sample has z up
    assert np.linalg.norm(found["SetCameraPositionMessage"]["position"]) == pytest.approx(
        1 / math.sin(math.radians(20))
    )
    assert found["SetSceneNodeVisibilityMessage"]["visible"] is False
    buffer = np.frombuffer(found["GaussianSplatsMessage"]["buffer"], np.uint32).reshape(-1, 8)
    means = unpacked(buffer).means
    assert len(means) == len(cup.surfels) and 0.7 < np.linalg.norm(means, axis=1).max() <= 1.0


def test_the_page_holds_all_that_it_loads_and_a_name_is_only_a_name():
    page = web_page('a "cup" </title><script>alert(1)</script>', b"123")
    assert "alert(1)</script>" not in page and "&lt;script&gt;alert(1)" in page
    outside = re.sub(r"<script.*?</script>|<style.*?</style>", "", page, flags=re.S)
    assert "src=" not in outside and "href=" not in outside and "//" not in outside
    assert "url(" not in re.sub(r"url\(\"?data:", "", "".join(re.findall(r"<style.*?</style>", page, flags=re.S)))
    assert "googletagmanager" not in page and page.count("</script>") == 2


def test_mistakes(tmp_path, monkeypatch):
    surfels, ids = discs()
    with pytest.raises(ValueError, match="needs the views"):
        make_exporter("html").write(tmp_path / "cup.html", ExportItem("cup", surfels, ids))
    with pytest.raises(NothingToExport, match="cup has no finite Gaussian"):
        make_exporter("html").write(tmp_path / "cup.html", ExportItem("cup", surfels[:0], ids[:0], viewpoints()))
    assert not list(tmp_path.iterdir())
    import viser

    monkeypatch.setattr(viser, "__file__", str(tmp_path / "__init__.py"))
    with pytest.raises(
        UserError, match=r"'html' cannot run here: the viewer of viser .* fit into one page; pip install viser==0.2.7"
    ):
        make_exporter("html")
    assets = tmp_path / "client/build/assets"
    assets.mkdir(parents=True)
    (assets / "index-1.js").write_text('new Worker("/assets/other.js")')
    (assets / "index-1.css").write_text("")
    with pytest.raises(UserError, match="does not fit into one page"):
        make_exporter("html")


@NEEDED
@pytest.mark.slow("a browser draws by WebGL in software")
def test_a_browser_draws_the_object_and_asks_no_network(tmp_path, cup):
    """The page from a disk, against our own picture from the same place."""
    rendered: list[int] = []
    item = replace(cup, on_render=rendered.append)
    assert make_exporter("html").write(tmp_path / "cup.html", item) == {}
    assert rendered == list(range(1, len(cup.views.cameras) + 1))
    seen = seen_colors(cup.surfels, cup.views, lambda done: None)
    found = messages(recording(cup, seen))
    low, high = bounding_box(cup.surfels)
    scale = 2 / float((high - low).norm())
    ours = replace(
        seen.surfels,
        means=((seen.surfels.means - (low + high) / 2) * scale).float(),
        log_scales=seen.surfels.log_scales + math.log(scale),
    )
    pixels = 400
    eye = found["SetCameraPositionMessage"]["position"]
    view = camera_at(tuple(eye), pixels=pixels)
    focal = 0.5 * pixels / math.tan(found["SetCameraFovMessage"]["fov"] / 2)
    K = torch.tensor([[focal, 0, 200.0], [0, focal, 200.0], [0, 0, 1]])
    expected = 255 * drawn(ours, Camera(view.viewmat, K, pixels, pixels)).numpy()
    silhouette = expected.min(axis=2) < DRAWN
    assert 0.05 < silhouette.mean() < 0.8

    with Page("about:blank", pixels, pixels) as page:
        page.follow((tmp_path / "cup.html").as_uri())

        def alike() -> bool:
            """Return whether page and picture overlap with the same colours there; Gaussians fade in one by one."""
            shown = np.asarray(Image.open(io.BytesIO(page.picture())).convert("RGB")).astype(float)
            on_page = shown.min(axis=2) < DRAWN
            both = silhouette & on_page
            overlap = both.sum() / max((silhouette | on_page).sum(), 1)
            return overlap > 0.85 and np.abs(shown[both] - expected[both]).mean() < 25

        page.wait(alike, 90)
        asked = list(page.asked)
    page_itself, *others = asked
    assert page_itself == (tmp_path / "cup.html").as_uri()
    assert others and not [url[:80] for url in others if not url.startswith(("data:", "blob:"))]
