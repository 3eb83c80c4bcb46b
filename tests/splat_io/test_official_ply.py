"""Splat files as the official programs lay them out, written here byte by byte, of scenes whose pictures are known.

3DGS and 2DGS write float32 columns in this order: x y z, nx ny nz (zeros), f_dc_0..2, f_rest_0..44 (all coefficients of
red, then of green, then of blue), opacity before the sigmoid, scales before exp (three or two), rot_0..3 as wxyz of any
length. The pictures expected follow from E1 to E4 for discs that face the camera, and from scipy's spherical harmonics.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
import torch
from random_surfels import random_surfels
from scipy.spatial.transform import Rotation
from scipy.special import expit, logit

from beags_plugin.core.cameras import Camera
from beags_plugin.core.flattening import flatten
from beags_plugin.export.base import make_exporter
from beags_plugin.importers.ply import PlyImporter
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.rasterizers.interface import RasterSettings
from beags_plugin.rasterizers.rendering import surfel_inputs
from beags_plugin.splat_io.ply import write_ply
from beags_plugin.surfaces.item import ExportItem
from beags_plugin.system.reading.ply import read_vertices

SIZE, FOCAL, DEPTH = 31, 40.0, 2.0  # pixels; the ray of the middle pixel meets the first disc's centre
TURN = Rotation.from_euler("xyz", (0.4, -0.7, 1.1))  # rotation of the camera in the world
EYE = np.array([0.3, -0.2, 0.5])
DISCS = (  # discs along the ray: depth, sizes along the image's axes, opacity
    (DEPTH, (0.30, 0.15), 0.7),
    (DEPTH + 0.5, (0.50, 0.80), 0.9),
)


def columns(scales: int) -> list[str]:
    """The names in the official order."""
    blocks = (("x", "y", "z", "nx", "ny", "nz"), _numbered("f_dc", 3), _numbered("f_rest", 45), ("opacity",))
    return [name for block in (*blocks, _numbered("scale", scales), _numbered("rot", 4)) for name in block]


def _numbered(prefix: str, count: int) -> tuple[str, ...]:
    return tuple(f"{prefix}_{index}" for index in range(count))


def coefficients() -> np.ndarray:
    """[2, 16, 3]: colours of the discs up to degree 3, each band of each channel another one."""
    found = 0.12 * np.random.default_rng(3).normal(size=(2, 16, 3))
    found[:, 0] += 0.4
    return found


def write_official(path: Path, thin_axis: int | None) -> None:
    """The discs, as Gaussians whose axis ``thin_axis`` is thin (3DGS), or with two scales (2DGS) where it is None."""
    rows = []
    for (depth, sizes, opacity), color in zip(DISCS, coefficients(), strict=True):
        axes = TURN.as_matrix()  # right, down and forward of the camera in the world: u, v and the normal
        scales = [*np.log(sizes), -9.0]
        if thin_axis is None:
            scales.pop()
        else:  # u, v, n; n, u, v; or v, n, u: turned by a third, so that it stays a rotation
            axes, scales = np.roll(axes, thin_axis - 2, axis=1), list(np.roll(scales, thin_axis - 2))
        x, y, z, w = 1.7 * Rotation.from_matrix(axes).as_quat()  # the official files hold it as it was trained
        rest = color[1:].T.ravel()  # channel by channel
        rows.append([*center(depth), 0, 0, 0, *color[0], *rest, logit(opacity), *scales, w, x, y, z])
    names = columns(2 if thin_axis is None else 3)
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    header += [*(f"property float {name}" for name in names), "end_header", ""]
    body = b"".join(struct.pack(f"<{len(names)}f", *row) for row in rows)
    path.write_bytes("\n".join(header).encode("ascii") + body)


def center(depth: float) -> np.ndarray:
    return EYE + depth * TURN.as_matrix()[:, 2]


def basis(direction: np.ndarray) -> np.ndarray:
    """[16]: real spherical harmonics of degree 0 to 3 with the Condon-Shortley phase, orders -l to l."""
    from scipy import special

    x, y, z = direction
    polar, around = np.arccos(z), np.arctan2(y, x)
    if hasattr(special, "sph_harm_y"):
        of = lambda degree, order: special.sph_harm_y(degree, order, polar, around)  # noqa: E731
    else:
        of = lambda degree, order: special.sph_harm(order, degree, around, polar)  # noqa: E731
    found = []
    for degree in range(4):
        for order in range(-degree, degree + 1):
            value = of(degree, abs(order))
            found.append(value.real if order == 0 else np.sqrt(2) * (value.imag if order < 0 else value.real))
    return np.array(found)


def expected() -> np.ndarray:
    """[H, W, 3]: the discs, composited on black."""
    pixels = np.arange(SIZE) - SIZE // 2
    picture, left = np.zeros((SIZE, SIZE, 3)), np.ones((SIZE, SIZE, 1))
    for (depth, (u, v), opacity), color in zip(DISCS, coefficients(), strict=True):
        across, down = np.meshgrid(pixels * depth / FOCAL, pixels * depth / FOCAL)
        alpha = opacity * np.exp(-0.5 * ((across / u) ** 2 + (down / v) ** 2))[..., None]
        seen = np.clip(basis(TURN.as_matrix()[:, 2]) @ color + 0.5, 0, None)
        picture, left = picture + left * alpha * seen, left * (1 - alpha)
    return picture


@pytest.mark.parametrize("thin_axis", [0, 1, 2, None], ids=["3dgs-first", "3dgs-second", "3dgs-third", "2dgs"])
def test_an_official_file_is_rendered_as_its_numbers_say(tmp_path, thin_axis):
    write_official(tmp_path / "point_cloud.ply", thin_axis)
    scene = PlyImporter().read(tmp_path / "point_cloud.ply")
    surfels, lost = flatten(scene.gaussians)
    assert scene.kind == ("2DGS .ply" if thin_axis is None else "3DGS .ply") and (lost is None) == (thin_axis is None)
    viewmat = np.eye(4)
    viewmat[:3, :3] = TURN.as_matrix().T
    viewmat[:3, 3] = -TURN.as_matrix().T @ EYE
    K = torch.tensor([[FOCAL, 0, SIZE / 2], [0, FOCAL, SIZE / 2], [0, 0, 1]])
    camera = Camera(torch.from_numpy(viewmat).float(), K, SIZE, SIZE)
    settings = RasterSettings(0.1, 100.0, geometry=False)
    drawn = make_rasterizer("auto").rasterize(surfel_inputs(surfels, camera), camera, settings, torch.zeros(3)).color
    picture = expected()
    inside = np.ones((SIZE, SIZE), bool)
    for depth, (u, v), opacity in DISCS:  # No rasterizer has cut a tail off there.
        across, down = np.meshgrid(*[(np.arange(SIZE) - SIZE // 2) * depth / FOCAL] * 2)
        inside &= opacity * np.exp(-0.5 * ((across / u) ** 2 + (down / v) ** 2)) > 0.05
    assert inside.sum() > 100 and picture[inside].std() > 0.05
    np.testing.assert_allclose(drawn.numpy()[inside], picture[inside], atol=2e-4)


@pytest.mark.parametrize("classes", [False, True])
def test_what_is_exported_for_2dgs_has_its_columns_in_its_order(tmp_path, classes):
    """Classes, if there are any, come behind what the official code asks for by name."""
    surfels, path = random_surfels(degree=2), tmp_path / "cup.ply"
    if classes:
        make_exporter("ply-2dgs").write(path, ExportItem("cup", surfels, torch.ones(7, dtype=torch.int32)))
    else:
        write_ply(path, surfels, layout="2dgs")
    lines = path.read_bytes().partition(b"end_header\n")[0].decode("ascii").splitlines()
    properties = [f"property float {name}" for name in columns(2)]
    last = ["property int class_id"] if classes else []
    head = ["ply", "format binary_little_endian 1.0", "comment SplatRenderMode: 2dgs", "element vertex 7"]
    assert lines == [*head, *properties, *last]
    row = np.frombuffer(path.read_bytes().partition(b"end_header\n")[2][: 4 * len(properties)], "<f4")
    assert np.array_equal(row[:3], surfels.means[0].numpy()) and np.array_equal(row[6:9], surfels.sh_dc[0].numpy())
    assert np.array_equal(row[9:54].reshape(3, 15)[:, :8], surfels.sh_rest[0].T.numpy())
    assert expit(row[54]) == pytest.approx(float(surfels.opacity_logits[0].sigmoid()))
    assert np.array_equal(row[55:57], surfels.log_scales[0].numpy())
    assert np.allclose(row[57:], torch.nn.functional.normalize(surfels.quats[0], dim=0).numpy(), atol=1e-7)
    vertex = read_vertices(path)
    normals = np.stack([vertex[f"n{axis}"] for axis in "xyz"], axis=1)
    turned = Rotation.from_quat(surfels.quats[:, [1, 2, 3, 0]].numpy()).as_matrix()[:, :, 2]
    assert np.allclose(normals, turned, atol=1e-6)


def test_the_3dgs_file_of_an_export_has_the_columns_of_its_degree(tmp_path):
    """3DGS asks for as many f_rest as its degree has; a viewer takes what is there."""
    write_ply(tmp_path / "cup.ply", random_surfels(degree=3))
    lines = (tmp_path / "cup.ply").read_bytes().partition(b"end_header\n")[0].decode("ascii").splitlines()
    assert lines[3:] == [f"property float {name}" for name in columns(3)]
