"""Densification and pruning while the base trains (method, section 1)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from beags_plugin.core.rotations import rotation_from_quat
from beags_plugin.core.sh import SH_C0, num_sh_bases
from beags_plugin.core.surfels import Surfels, opacities

if TYPE_CHECKING:
    from beags_plugin.options.stages import DensifyConfig

# These values are those of the official code of 2DGS (Huang et al., SIGGRAPH 2024); scales are relative to the extent.
GRADIENT_THRESHOLD = 2e-4  # mean screen gradient from which a Gaussian is cloned or split
CLONE_SCALE = 0.01  # a larger Gaussian is split, a smaller one cloned
SPLIT_SHRINK = 1.6  # both halves of a split Gaussian are this much smaller
PRUNE_OPACITY = 0.05  # fainter Gaussians are pruned
PRUNE_SCALE = 0.1  # larger Gaussians are pruned
RESET_OPACITY = 0.01
INITIAL_OPACITY = 0.1
# Ours, for runs that are shorter than the official ones: ``scaled`` makes no interval shorter than these.
LEAST_EVERY = 50  # gradients must be averaged over many views
LEAST_RESET_EVERY = 1_000  # opacities need time to recover
COINCIDENT = 1e-7  # smallest initial scale relative to the cloud's size: coincident points have no neighbour distance


def scaled(config: DensifyConfig, factor: float) -> DensifyConfig:
    """Return the options for a run ``factor`` times as long; no interval falls below the least ones."""

    def steps(stated: int, least: int = 0) -> int:
        return max(round(stated * factor), min(least, stated)) if stated > 0 else stated

    return replace(
        config,
        every=max(steps(config.every, LEAST_EVERY), 1),
        start=steps(config.start),
        stop=steps(config.stop),
        prune_scale_after=steps(config.prune_scale_after, 1),
        reset_every=steps(config.reset_every, LEAST_RESET_EVERY),
    )


def bounded(config: DensifyConfig, pixels: int) -> DensifyConfig:
    """Return the options with ``max_surfels`` for this many training pixels."""
    if not config.pixels_per_surfel > 0:
        return config
    by_pixels = max(int(pixels / config.pixels_per_surfel), 1)
    return replace(config, max_surfels=min(by_pixels, config.max_surfels) if config.max_surfels > 0 else by_pixels)


def grows_at(config: DensifyConfig, done: int) -> bool:
    """Return whether the scene is densified after ``done`` steps."""
    return config.start < done < config.stop and done % config.every == 0


def frees_at(config: DensifyConfig, done: int, base_steps: int) -> bool:
    """Return whether the space before cameras is freed after ``done`` steps of a base of ``base_steps``."""
    return config.free_share > 0.0 and config.start < done < base_steps and done % config.every == 0


def resets_at(config: DensifyConfig, done: int) -> bool:
    """Return whether opacities are reset after ``done`` steps."""
    return config.reset_every > 0 and done < config.stop and done % config.reset_every == 0


@dataclass(frozen=True)
class Densified:
    """The edited scene: M Gaussians, the index [M] that each came from, and whether it is new, fresh [M] bool."""

    surfels: Surfels
    source: Tensor
    fresh: Tensor

    @classmethod
    def unchanged(cls, surfels: Surfels) -> Densified:
        """Return a scene before any edit."""
        count, device = len(surfels), surfels.means.device
        return cls(surfels, torch.arange(count, device=device), torch.zeros(count, dtype=torch.bool, device=device))

    def then(self, edited: Densified) -> Densified:
        """Return this edit followed by ``edited``, whose sources are this one's surfels."""
        return Densified(edited.surfels, self.source[edited.source], self.fresh[edited.source] | edited.fresh)

    def only(self, keep: Tensor) -> Densified:
        """Return this edit with the Gaussians of ``keep`` [M] bool alone; at least the most opaque one remains."""
        if not bool(keep.any()):
            keep = keep.index_fill(0, self.surfels.opacity_logits.argmax(), True)
        return Densified(self.surfels[keep], self.source[keep], self.fresh[keep])


class GradientStatistics:
    """Mean screen gradient of N Gaussians over the views that saw them."""

    def __init__(self, count: int, device: torch.device | str = "cpu") -> None:
        self.total = torch.zeros(count, device=device)
        self.views = torch.zeros(count, device=device)

    def add(self, gradient: Tensor, visible: Tensor) -> None:
        """Add one view: gradient [N], counted where visible [N] bool."""
        seen = visible & torch.isfinite(gradient)
        self.total += torch.where(seen, gradient, 0.0).to(self.total)
        self.views += seen.to(self.views)

    def mean(self) -> Tensor:
        """Return [N]; 0 for a Gaussian that no view saw."""
        return self.total / self.views.clamp_min(1.0)


def length_units(means: Tensor, camera_centers: Tensor, extent: float, config: DensifyConfig) -> Tensor:
    """Return the lengths [N], world units, that ``CLONE_SCALE`` and ``PRUNE_SCALE`` multiply at ``means``.

    They are the scene's extent, or with ``far_limits`` the distance of the nearest camera if larger. means: [N, 3].
    camera_centers: [V, 3].
    """
    units = means.new_full((means.shape[0],), extent)
    if not config.far_limits:
        return units
    from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]  (compiled, without stubs)

    finite = torch.nan_to_num(means.double(), nan=0.0, posinf=0.0, neginf=0.0)
    distances = torch.from_numpy(cKDTree(camera_centers.double().cpu().numpy()).query(finite.cpu().numpy())[0])
    return torch.maximum(units, distances.to(units))


def densify(
    surfels: Surfels, mean_gradient: Tensor, units: Tensor, config: DensifyConfig, step: int,
    generator: torch.Generator, apart: tuple[Tensor, int] | None = None,
) -> Densified:  # fmt: skip
    """Clone, split and prune Gaussians.

    surfels: N Gaussians without gradients. mean_gradient: [N]. units: [N] of ``length_units``. step: the current step,
    for ``prune_scale_after``. apart: [N] bool, Gaussians with a bound of their own, and that bound (0: none); the
    config's bounds the others. At least one Gaussian always remains.
    """
    size = surfels.log_scales.exp().amax(dim=-1)
    chosen = mean_gradient >= GRADIENT_THRESHOLD
    if apart is None:
        chosen = _within_budget(chosen, mean_gradient, config.max_surfels, len(surfels))
    else:
        bounds = ((apart[0], apart[1]), (~apart[0], config.max_surfels))
        parts = [_within_budget(chosen & part, mean_gradient, most, int(part.sum())) for part, most in bounds]
        chosen = parts[0] | parts[1]
    small = size <= CLONE_SCALE * units
    edited = _grow(surfels, chosen & small, chosen & ~small, generator)

    grown, source = edited.surfels, edited.source
    keep = opacities(grown.opacity_logits) >= PRUNE_OPACITY
    if 0 < config.prune_scale_after < step:
        keep &= grown.log_scales.exp().amax(dim=-1) <= PRUNE_SCALE * units[source]
    return edited.only(keep)


def split_by_sampling(surfels: Surfels, chosen: Tensor, generator: torch.Generator) -> Densified:
    """Replace each chosen Gaussian by two copies, placed by its own density and smaller by ``SPLIT_SHRINK``.

    surfels: N Gaussians without gradients. chosen: [N] bool. The others keep their order; the copies follow them. This
    is the split of densification.
    """
    return _grow(surfels, torch.zeros_like(chosen), chosen, generator)


def _grow(surfels: Surfels, cloned: Tensor, split: Tensor, generator: torch.Generator) -> Densified:
    """Add copies of the ``cloned`` [N] bool, then replace each ``split`` [N] bool by two; see ``split_by_sampling``."""
    rest, clones, splits = (which.nonzero()[:, 0] for which in (~split, cloned, split))
    source = torch.cat([rest, clones, splits, splits])
    fresh = torch.zeros_like(source, dtype=torch.bool)
    fresh[rest.shape[0] :] = True
    grown = surfels[source]
    halves = slice(rest.shape[0] + clones.shape[0], None)
    grown.means[halves] += _offsets(grown[halves], generator)
    grown.log_scales[halves] -= math.log(SPLIT_SHRINK)
    return Densified(grown, source, fresh)


def _within_budget(chosen: Tensor, gradient: Tensor, max_surfels: int, count: int) -> Tensor:
    """Restrict the chosen to those of largest gradient that fit beside ``count`` Gaussians (``max_surfels`` 0: all)."""
    room = max(max_surfels - count, 0)
    if max_surfels <= 0 or int(chosen.sum()) <= room:
        return chosen
    order = torch.where(chosen, gradient, -1.0).argsort(descending=True, stable=True)[:room]
    limited = torch.zeros_like(chosen)
    limited[order] = True
    return limited


def _offsets(surfels: Surfels, generator: torch.Generator) -> Tensor:
    """Sample a point of each Gaussian in its plane, [M, 3]."""
    normal = torch.randn(len(surfels), 2, generator=generator).to(surfels.means)
    local = normal * surfels.log_scales.exp()
    axes = rotation_from_quat(surfels.quats)[:, :, :2]
    return (axes @ local[:, :, None])[:, :, 0]


def reset_opacity(surfels: Surfels) -> Tensor:
    """Return [N] opacity logits, lowered to at most ``RESET_OPACITY``."""
    ceiling = math.log(RESET_OPACITY / (1.0 - RESET_OPACITY))
    return surfels.opacity_logits.clamp_max(ceiling)


def initial_surfels(points: Tensor, colors: Tensor, sh_degree: int, generator: torch.Generator) -> Surfels:
    """Make one Gaussian per seed point: sized by the distance of its neighbours, faint and randomly rotated.

    points: [N, 3] world. colors: [N, 3] in 0..1. Returns N Gaussians in float32 without gradients.
    """
    from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]  (compiled, without stubs)

    count = points.shape[0]
    cloud = points.double().cpu().numpy()
    neighbours = min(4, count)
    distances = torch.from_numpy(cKDTree(cloud).query(cloud, k=neighbours)[0]).reshape(count, neighbours)[:, 1:]
    spread = float((points - points.mean(dim=0)).norm(dim=-1).max()) if count > 1 else 1.0
    squared = distances.square().mean(dim=-1) if neighbours > 1 else torch.ones(count, dtype=torch.float64)
    scale = squared.sqrt().clamp_min(COINCIDENT * max(spread, 1e-30))
    return Surfels(
        means=points.float().clone(),
        quats=torch.nn.functional.normalize(torch.randn(count, 4, generator=generator), dim=-1),
        log_scales=scale.log().float()[:, None].repeat(1, 2),
        opacity_logits=torch.full((count,), math.log(INITIAL_OPACITY / (1.0 - INITIAL_OPACITY))),
        sh_dc=(colors.float() - 0.5) / SH_C0,
        sh_rest=torch.zeros(count, num_sh_bases(sh_degree) - 1, 3),
    )
