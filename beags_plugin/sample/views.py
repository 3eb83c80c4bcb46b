"""The sample's cameras, and the pictures that they take."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beags_plugin.sample.scene import DirectLighting, Lighting, Scene
from beags_plugin.sample.solids import turned
from beags_plugin.sample.tracing import CHUNK, first_hits

ELEVATIONS = (0.34, 0.66, 1.02)
"""Elevations of the three rounds of cameras above the ground, radians; their field of view is 48 degrees wide."""
TARGET = np.array([0.0, 0.0, 0.26])


@dataclass(frozen=True)
class View:
    """One pinhole camera.

    name: file stem. split: "train" or "test".
    camera_to_world: [4, 4] float64, OpenGL axes (x right, y up, z backward), world z up.
    focal, cx, cy: pixels; pixel (i, j) has its centre at (i + 0.5, j + 0.5).
    """

    name: str
    split: str
    camera_to_world: np.ndarray
    focal: float
    cx: float
    cy: float
    width: int
    height: int

    @property
    def center(self) -> np.ndarray:
        """Return the camera's position in the world, [3]."""
        return self.camera_to_world[:3, 3]

    def directions(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return [N, 3] world directions through image points x, y [N] (pixels), of depth 1 along the optical axis."""
        camera = np.stack([(x - self.cx) / self.focal, -(y - self.cy) / self.focal, -np.ones_like(x)], axis=1)
        return turned(camera, self.camera_to_world[:3, :3].T)


@dataclass(frozen=True)
class Picture:
    """The images of a view.

    image: [H, W, 3] uint8 sRGB, antialiased by supersampling. The rest is exact at the pixel centres:
    labels: [H, W] uint8 visible class ids. depth: [H, W] float32 z along the optical axis (every ray hits something).
    silhouettes: [L, H, W] bool, object i + 1 as if it were alone.
    """

    image: np.ndarray
    labels: np.ndarray
    depth: np.ndarray
    silhouettes: np.ndarray


def make_views(seed: int, width: int, height: int, num_train: int, num_test: int) -> list[View]:
    """Make three jittered rounds around the scene at rising height, with test views spread evenly."""
    generator = np.random.default_rng([seed, 2])
    total = num_train + num_test
    tests = set(held_out(num_train, num_test))
    start = generator.uniform(0.0, 2.0 * np.pi)
    views = []
    for i in range(total):
        progress = i * len(ELEVATIONS) / total
        azimuth = start + 2.0 * np.pi * progress + generator.uniform(-0.05, 0.05)
        elevation = ELEVATIONS[int(progress)] + generator.uniform(-0.06, 0.06)
        radius = (2.3 + 0.12 * int(progress)) * generator.uniform(0.94, 1.06)
        target = TARGET + generator.uniform(-0.06, 0.06, 3)
        place = target + radius * direction(azimuth, elevation)
        pose = look_at(place, target, generator.uniform(-0.04, 0.04))
        views.append(make_view(i, i in tests, pose, 1.12, width, height))
    return views


def direction(azimuth: float, elevation: float) -> np.ndarray:
    """Return the unit vector [3] at an azimuth from x and an elevation above z = 0, radians."""
    return np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])


def held_out(num_train: int, num_test: int) -> list[int]:
    """Return the indices of the test views, spread evenly over all views."""
    return [int((i + 0.5) * (num_train + num_test) / num_test) for i in range(num_test)]


def make_view(index: int, test: bool, pose: np.ndarray, lens: float, width: int, height: int) -> View:
    """Return the view number ``index``; lens: focal length over width, the same for all views of a scene."""
    return View(
        name=f"view_{index:03d}",
        split="test" if test else "train",
        camera_to_world=pose,
        focal=lens * width,
        cx=0.5 * width + 0.015 * width,  # The axis is slightly off the middle of the image.
        cy=0.5 * height - 0.011 * height,
        width=width,
        height=height,
    )


def look_at(position: np.ndarray, target: np.ndarray, roll: float) -> np.ndarray:
    """Return the camera-to-world matrix [4, 4] of a camera at ``position`` that looks at ``target``."""
    back = position - target
    back = back / np.linalg.norm(back)
    right = np.cross([0.0, 0.0, 1.0], back)
    right = right / np.linalg.norm(right)
    up = np.cross(back, right)
    pose = np.eye(4)
    pose[:3, 0] = np.cos(roll) * right + np.sin(roll) * up
    pose[:3, 1] = np.cos(roll) * up - np.sin(roll) * right
    pose[:3, 2], pose[:3, 3] = back, position
    return pose


def _grid(view: View, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Return image points x, y [H W samples^2]: per pixel, row by row, the centres of samples x samples squares."""
    offset = (np.arange(samples) + 0.5) / samples
    x = (np.arange(view.width)[:, None] + offset).ravel()
    y = (np.arange(view.height)[:, None] + offset).ravel()
    yy, xx = np.meshgrid(y, x, indexing="ij")
    shape = (view.height, samples, view.width, samples)
    return tuple(a.reshape(shape).transpose(0, 2, 1, 3).reshape(-1) for a in (xx, yy))  # type: ignore[return-value]


def pixel_directions(view: View) -> np.ndarray:
    """Return [H W, 3] world directions through the pixel centres, row by row, of depth 1 along the optical axis."""
    return view.directions(*_grid(view, 1))


def render_image(scene: Scene, light: Lighting, view: View, samples: int) -> np.ndarray:
    """Render [H, W, 3] uint8 sRGB, the mean in linear light over samples x samples rays per pixel."""
    pixels = _pixels(scene, light, view, view.directions(*_grid(view, samples)), samples * samples)
    return pixels.reshape(view.height, view.width, 3)


def render_pixels(scene: Scene, light: Lighting, view: View, pixels: np.ndarray, samples: int) -> np.ndarray:
    """Render [P, 3] uint8 sRGB, the pixels [P] of ``render_image``, numbered row by row."""
    directions = view.directions(*_grid(view, samples)).reshape(-1, samples * samples, 3)[pixels].reshape(-1, 3)
    return _pixels(scene, light, view, directions, samples * samples)


def _pixels(scene: Scene, light: Lighting, view: View, directions: np.ndarray, per_pixel: int) -> np.ndarray:
    """Return [P, 3] uint8 sRGB of pixels with ``per_pixel`` directions each, in order."""
    chunk = CHUNK // per_pixel * per_pixel
    pieces = []
    for start in range(0, len(directions), chunk):
        part = directions[start : start + chunk]
        if isinstance(light, DirectLighting):
            colours = light.seen(view.center, part)
        else:
            hits, _ = first_hits(scene, view.center, part)
            colours = light.colours(view.center + hits.t[:, None] * part, hits.surface, part, view.center)
        pieces.append(np.minimum(colours, 1.0).reshape(-1, per_pixel, 3).mean(axis=1))
    return np.floor(255.0 * np.concatenate(pieces) ** (1.0 / 2.2) + 0.5).astype(np.uint8)


def render_view(scene: Scene, light: Lighting, view: View, samples: int = 2) -> Picture:
    """Render the picture of a view, with ``samples`` x ``samples`` rays per pixel for the image."""
    hits, silhouettes = first_hits(scene, view.center, pixel_directions(view))
    masks = np.zeros((len(scene.things), len(hits.t)), dtype=bool)
    for mask, rays in zip(masks, silhouettes, strict=True):
        mask[rays] = True
    shape = (view.height, view.width)
    return Picture(
        image=render_image(scene, light, view, samples),
        labels=np.maximum(hits.surface, 0).astype(np.uint8).reshape(shape),
        depth=hits.t.astype(np.float32).reshape(shape),  # Directions have depth 1, so t is z.
        silhouettes=masks.reshape(-1, *shape),
    )
