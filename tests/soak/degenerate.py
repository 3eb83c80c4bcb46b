"""Random scenes of surfels that are as bad as parameters can get, each decided by its number alone."""

from __future__ import annotations

import math
import random
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.core.rotations import rotation_from_quat
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.rasterizers.interface import RasterSettings, SurfelInputs

FLOATS = ("means", "quats", "log_scales", "opacity_logits", "colors")
_SIZES = ((1, 1), (1, 7), (5, 1), (2, 3), (9, 8), (16, 16), (17, 15), (33, 5), (31, 33))  # width, height
_COUNTS = (0, 1, 1, 2, 3, 5, 8, 13, 24)
_CLASSES = (1, 2, 4, 300, 65_535)
_WORLD_SCALES = (1.0, 1.0, 1.0, 1e-4, 1e6)
_WORLD_SHIFTS = (0.0, 0.0, 0.0, 1e5)


@dataclass(frozen=True)
class Scene:
    """Inputs of ``Rasterizer.rasterize`` in float64, and the ways in which they are spoilt.

    target: [H, W] int32 class ids, or IGNORE. num_classes: ids lie below it. spoilt: of each surfel, what is wrong
    with it; "" nothing. world: (scale, shift) of the world's unit and origin.
    """

    inputs: SurfelInputs
    camera: Camera
    settings: RasterSettings
    background: Tensor
    target: Tensor
    num_classes: int
    spoilt: tuple[str, ...]
    world: tuple[float, float]

    def to(self, dtype: torch.dtype) -> Scene:
        """Return the scene in another precision, in which a number may become 0 or infinite."""
        camera, background = self.camera.to(dtype), self.background.to(dtype)
        return replace(self, inputs=self.inputs.to(dtype), camera=camera, background=background)


def degenerate_scene(seed: int) -> Scene:
    """Return scene number ``seed``, which does not depend on scenes made before it."""
    dice = random.Random(seed)
    width, height = dice.choice(_SIZES)
    count, num_classes = dice.choice(_COUNTS), dice.choice(_CLASSES)
    unit, shift = dice.choice(_WORLD_SCALES), dice.choice(_WORLD_SHIFTS)
    camera = _camera(dice, width, height)
    surfels: list[dict[str, list[float]]] = []
    spoilt: list[str] = []
    for _ in range(count):
        surfel = _ordinary(dice)
        names = dice.choices(("", *_WAYS), k=dice.choice((0, 1, 1, 2)))
        for name in names:
            if name:
                _WAYS[name](dice, surfel, camera, surfels)
        surfels.append(surfel)
        spoilt.append("+".join(name for name in names if name))
    values = {
        name: torch.tensor([surfel[name] for surfel in surfels], dtype=torch.float64).reshape(count, *shape)
        for name, shape in (
            ("means", (3,)),
            ("quats", (4,)),
            ("log_scales", (2,)),
            ("opacity_logits", ()),
            ("colors", (3,)),
        )
    }
    values["means"] = values["means"] * unit + shift
    values["log_scales"] = values["log_scales"] + math.log(unit)
    viewmat = camera.viewmat.clone()
    viewmat[:3, 3] = camera.translation * unit - camera.rotation @ torch.full((3,), shift, dtype=torch.float64)
    ids = torch.tensor([dice.randrange(num_classes) for _ in range(count)], dtype=torch.int32)
    return Scene(
        inputs=SurfelInputs(**values, class_ids=ids),
        camera=replace(camera, viewmat=viewmat),
        settings=RasterSettings(0.01 * unit, 100.0 * unit, geometry=True, distortion=dice.random() < 0.7),
        background=torch.tensor([dice.random() for _ in range(3)], dtype=torch.float64),
        target=_target(dice, height, width, num_classes),
        num_classes=num_classes,
        spoilt=tuple(spoilt),
        world=(unit, shift),
    )


def _camera(dice: random.Random, width: int, height: int) -> Camera:
    quat = torch.tensor([dice.gauss(0, 1) for _ in range(4)], dtype=torch.float64)
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = rotation_from_quat(quat)
    viewmat[:3, 3] = torch.tensor([dice.gauss(0, 0.3), dice.gauss(0, 0.3), 3.0 + dice.random()])
    focal = max(width, height) * dice.choice((0.3, 1.0, 1.0, 4.0))
    middle = (width * dice.choice((0.5, 0.5, -0.2)), height * dice.choice((0.5, 0.5, 1.1)))
    K = torch.tensor([[focal, 0.0, middle[0]], [0.0, 1.1 * focal, middle[1]], [0.0, 0.0, 1.0]], dtype=torch.float64)
    return Camera(viewmat, K, width, height)


def _target(dice: random.Random, height: int, width: int, num_classes: int) -> Tensor:
    kind = dice.choice(("random", "one", "ignore"))
    if kind == "ignore":
        return torch.full((height, width), IGNORE, dtype=torch.int32)
    ids = [dice.randrange(num_classes) for _ in range(height * width if kind == "random" else 1)]
    target = torch.tensor(ids, dtype=torch.int32).expand(height * width).reshape(height, width).clone()
    for row in range(height):
        if dice.random() < 0.2:
            target[row, dice.randrange(width)] = IGNORE
    return target


def _ordinary(dice: random.Random) -> dict[str, list[float]]:
    """Return a surfel near the middle of the picture."""
    return {
        "means": [dice.gauss(0, 0.8) for _ in range(3)],
        "quats": [dice.gauss(0, 1) for _ in range(4)],
        "log_scales": [dice.gauss(-1.4, 0.6) for _ in range(2)],
        "opacity_logits": [dice.gauss(1, 2)],
        "colors": [dice.random() for _ in range(3)],
    }


def _in_camera(camera: Camera, point: list[float]) -> list[float]:
    """World coordinates of a point that is given in the camera's frame."""
    away = torch.tensor(point, dtype=torch.float64) - camera.translation
    return (camera.rotation.T @ away).tolist()


def _edge_on(dice: random.Random, surfel, camera: Camera, others) -> None:
    """Turn the disc's plane to the camera, up to an angle of 0.1 down to 0."""
    ray = torch.tensor(surfel["means"], dtype=torch.float64) - camera.center
    ray = ray / ray.norm()
    side = torch.linalg.cross(ray, torch.tensor([dice.gauss(0, 1) for _ in range(3)], dtype=torch.float64))
    side = side / side.norm()
    tilt = dice.choice((0.0, 10.0 ** -dice.uniform(1, 9)))
    normal = side * math.cos(tilt) + ray * math.sin(tilt)
    first = torch.linalg.cross(normal, ray)
    first = first / first.norm()
    surfel["quats"] = _quat(torch.stack([first, torch.linalg.cross(normal, first), normal], dim=1))


def _quat(rotation: Tensor) -> list[float]:
    """Return the quaternion wxyz of a rotation matrix, by the largest of the four components."""
    m = rotation.tolist()
    squares = [
        1 + m[0][0] + m[1][1] + m[2][2], 1 + m[0][0] - m[1][1] - m[2][2],
        1 - m[0][0] + m[1][1] - m[2][2], 1 - m[0][0] - m[1][1] + m[2][2],
    ]  # fmt: skip
    a, b, c = m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1]
    d, e, f = m[1][0] + m[0][1], m[0][2] + m[2][0], m[2][1] + m[1][2]
    rows = ((None, a, b, c), (a, None, d, e), (b, d, None, f), (c, e, f, None))
    largest = max(range(4), key=lambda i: squares[i])
    return [squares[largest] if value is None else value for value in rows[largest]]


def _crossing(dice: random.Random, surfel, camera: Camera, others) -> None:
    """Let the disc reach through the camera's plane."""
    surfel["means"] = _in_camera(camera, [dice.gauss(0, 0.3), dice.gauss(0, 0.3), 10.0 ** -dice.uniform(0, 8)])
    surfel["log_scales"] = [dice.uniform(-1, 1), dice.uniform(-1, 1)]


def _behind(dice: random.Random, surfel, camera: Camera, others) -> None:
    surfel["means"] = _in_camera(camera, [dice.gauss(0, 1), dice.gauss(0, 1), -(10.0 ** dice.uniform(-8, 2))])


def _at_camera(dice: random.Random, surfel, camera: Camera, others) -> None:
    surfel["means"] = camera.center.tolist()


def _size(dice: random.Random, surfel, camera: Camera, others) -> None:
    """Draw each scale from 1e-12 to 1e8, so that ratios go far beyond 1e9."""
    surfel["log_scales"] = [math.log(10.0) * dice.uniform(-12, 8) for _ in range(2)]


def _opacity(dice: random.Random, surfel, camera: Camera, others) -> None:
    surfel["opacity_logits"] = [dice.choice((-1e4, -90.0, -5.54, 37.0, 90.0, 1e4))]


def _quaternion(dice: random.Random, surfel, camera: Camera, others) -> None:
    """Give the quaternion a length of 0, or a denormal, tiny or enormous one."""
    factor = dice.choice((0.0, 5e-324, 1e-310, 1e-170, 1e-40, 1e-20, 1e20, 1e40, 1e160, 1e300))
    surfel["quats"] = [factor * value for value in surfel["quats"]]


def _coincident(dice: random.Random, surfel, camera: Camera, others) -> None:
    """Take the centre, and perhaps the plane, of an earlier surfel."""
    if others:
        other = dice.choice(others)
        for name in dice.choice((("means",), ("means", "quats"), ("means", "quats", "log_scales"))):
            surfel[name] = list(other[name])


def _far(dice: random.Random, surfel, camera: Camera, others) -> None:
    """Move the surfel beyond the far plane, as far as squares overflow float32."""
    surfel["means"] = [value * 10.0 ** dice.uniform(2, 25) for value in surfel["means"]]


def _broken(dice: random.Random, surfel, camera: Camera, others) -> None:
    """Make one number NaN or infinite."""
    name = dice.choice(FLOATS)
    surfel[name] = list(surfel[name])
    surfel[name][dice.randrange(len(surfel[name]))] = dice.choice((math.nan, math.inf, -math.inf))


_WAYS = {
    "edge-on": _edge_on,
    "crossing": _crossing,
    "behind": _behind,
    "at the camera": _at_camera,
    "size": _size,
    "opacity": _opacity,
    "quaternion": _quaternion,
    "coincident": _coincident,
    "far": _far,
    "broken": _broken,
}
