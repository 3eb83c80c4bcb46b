"""The reference rasterizer: plain differentiable PyTorch, to be read beside the equations (method, sections 1, 4)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from beags_plugin.core.cameras import Camera
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.labels.class_ranks import ClassRanks
from beags_plugin.rasterizers.interface import (
    MIN_TRANSMITTANCE,
    Rasterizer,
    RasterOutputs,
    RasterSettings,
    SurfelInputs,
    map_ids,
    sparse_table,
)
from beags_plugin.rasterizers.optional import OptionalProducts
from beags_plugin.rasterizers.reference_geometry import ProjectedSurfels, hits, on_screen, project
from beags_plugin.rasterizers.rendering import class_channels_by_threes

KEPT_PER_PAIR = 40  # numbers that autograd keeps per pixel and Gaussian; measured
BLOCK = 16  # pixels are rendered in squares of this side, each with the Gaussians that reach it


@dataclass(frozen=True)
class _Block:
    """P pixels of a square, and S Gaussians that reach it, nearest first.

    rows, columns: slices of the image. index: [S] int64 indices of the inputs; chosen: [S] of the projected surfels.
    weights: [P, S] w_i. depth: [P, S]. remaining: [P] T_end. before, after: [P, S] transmittance around each surfel.
    """

    rows: slice
    columns: slice
    index: Tensor
    chosen: Tensor
    weights: Tensor
    depth: Tensor
    remaining: Tensor
    before: Tensor
    after: Tensor


class TorchRasterizer(Rasterizer, OptionalProducts):
    """Autograd through dense blocks: slow, exact in float64, on any device.

    smooth_cutoff: fade alpha out at 1/255 instead of cutting it, so that finite differences hold; for tests.
    memory_limit: bytes; a render that would keep more for its backward computes each block twice instead.
    """

    def __init__(self, smooth_cutoff: bool = False, memory_limit: float = 4e9) -> None:
        self.smooth_cutoff = smooth_cutoff
        self.memory_limit = memory_limit

    @classmethod
    def unavailable(cls) -> str | None:
        return None

    def rasterize(
        self,
        inputs: SurfelInputs,
        camera: Camera,
        settings: RasterSettings,
        background: Tensor,
        target: Tensor | None = None,
    ) -> RasterOutputs:
        inputs = inputs.checked()
        camera = camera.to(inputs.means)
        if target is not None and inputs.class_ids is None:
            raise ValueError("a target needs class_ids")
        projected = project(inputs, camera, settings)
        images = self._render(projected, inputs, camera, settings, background, target)
        visible = torch.zeros(len(inputs.means), dtype=torch.bool, device=inputs.means.device)
        visible[projected.index] = on_screen(projected, 0, 0, camera.width, camera.height)
        return RasterOutputs(
            color=images["color"],
            alpha=images["alpha"][..., 0],
            depth=images["depth"][..., 0] if settings.geometry else None,
            median_depth=images["median"][..., 0] if settings.geometry else None,
            normal=images["normal"] if settings.geometry else None,
            distortion=images["distortion"][..., 0] if settings.distortion else None,
            boundary=images["boundary"][..., 0] if target is not None else None,
            visible=visible,
            num_nonfinite=projected.num_nonfinite,
        )

    def class_contributions(
        self, inputs: SurfelInputs, camera: Camera, settings: RasterSettings, labels: Tensor, num_classes: int
    ) -> Tensor:
        return self._class_sums(inputs, camera, settings, labels, num_classes, lambda weights: weights)

    def sparse_class_pixel_counts(
        self,
        inputs: SurfelInputs,
        camera: Camera,
        settings: RasterSettings,
        labels: Tensor,
        num_classes: int,
        min_weight: float = 0.0,
    ) -> tuple[Tensor, Tensor]:
        def table(slots: Tensor, count: int) -> Tensor:
            return self._class_sums(
                inputs, camera, settings, slots, count, lambda weights: (weights > min_weight).to(weights)
            )

        keys, counts = sparse_table(table, labels, num_classes)
        return keys, counts.int()

    def sparse_top_contributions(
        self,
        inputs: SurfelInputs,
        camera: Camera,
        settings: RasterSettings,
        labels: Tensor,
        num_classes: int,
        most: int,
        within: int,
    ) -> tuple[Tensor, Tensor]:
        def largest(weights: Tensor) -> Tensor:
            first = torch.where((weights > 0).cumsum(dim=-1) <= within, weights, torch.zeros_like(weights))
            rank = first.sort(dim=-1, descending=True, stable=True).indices.argsort(dim=-1)  # The nearer wins ties.
            return torch.where(rank < most, first, torch.zeros_like(first))

        def table(slots: Tensor, count: int) -> Tensor:
            return self._class_sums(inputs, camera, settings, slots, count, largest)

        return sparse_table(table, labels, num_classes)

    @torch.no_grad()
    def _class_sums(
        self,
        inputs: SurfelInputs,
        camera: Camera,
        settings: RasterSettings,
        labels: Tensor,
        num_classes: int,
        counted: Callable[[Tensor], Tensor],
    ) -> Tensor:
        """Sum ``counted`` of the weights [P, S] by Gaussian and label, [N, num_classes]."""
        total = inputs.means.new_zeros(inputs.means.shape[0], num_classes)
        for block in self._blocks(inputs, camera, settings):
            here = labels[block.rows, block.columns].reshape(-1).long()
            one_hot = (here[:, None] == torch.arange(num_classes, device=here.device)).to(block.weights)
            total[block.index] += counted(block.weights).T @ one_hot  # (E6); IGNORE matches no class
        return total

    @torch.no_grad()
    def class_map(
        self, inputs: SurfelInputs, camera: Camera, settings: RasterSettings, num_classes: int
    ) -> tuple[Tensor, Tensor]:
        class_ids = map_ids(inputs, num_classes)
        rows = _Rows()
        for block in self._blocks(inputs, camera, settings):
            ids = class_ids[block.index]
            here = ClassRanks(ids)  # Only the block's classes get a column: there may be 65,535 in all.
            one_hot = (here.ranks(ids)[:, None] == torch.arange(len(here), device=ids.device)).to(block.weights)
            per_class = block.weights @ one_hot
            best = per_class.argmax(dim=-1)  # The first of equals wins, so ties go to the lower id.
            alpha = block.weights.sum(dim=-1)
            share = per_class.gather(1, best[:, None])[:, 0] / torch.where(alpha > 0, alpha, torch.ones_like(alpha))
            rows.put(block.rows, block.columns, {"class": here.class_ids(best)[:, None], "share": share[:, None]})
        images = rows.join()
        return images["class"][..., 0], images["share"][..., 0]

    def class_channels(
        self, inputs: SurfelInputs, camera: Camera, settings: RasterSettings, num_classes: int
    ) -> Tensor:
        return class_channels_by_threes(self, inputs, camera, settings, num_classes)

    @torch.no_grad()
    def dominant_gaussian(self, inputs: SurfelInputs, camera: Camera, settings: RasterSettings) -> Tensor:
        image = torch.full((camera.height, camera.width), -1, dtype=torch.int32, device=inputs.means.device)
        for block in self._blocks(inputs, camera, settings):
            if block.index.shape[0] == 0:
                continue
            weight, place = block.weights.max(dim=-1)
            winner = torch.where(weight > 0, block.index[place], torch.full_like(place, -1)).to(torch.int32)
            image[block.rows, block.columns] = winner.reshape(image[block.rows, block.columns].shape)
        return image

    def _render(
        self,
        projected: ProjectedSurfels,
        inputs: SurfelInputs,
        camera: Camera,
        settings: RasterSettings,
        background: Tensor,
        target: Tensor | None,
    ) -> dict[str, Tensor]:
        """Render all images block by block, differentiably."""

        def render_block(rows: slice, columns: slice) -> dict[str, Tensor]:
            block = self._block(projected, rows, columns, settings)
            return _composite(block, inputs, projected, settings, background, target)

        # The memory of autograd grows with the scene: beyond the limit the backward renders each block again.
        again = torch.is_grad_enabled() and _autograd_bytes(projected, camera) > self.memory_limit
        images = _Rows()
        for rows, columns in _squares(camera):
            if again:
                images_here = checkpoint(render_block, rows, columns, use_reentrant=False, preserve_rng_state=False)
            else:
                images_here = render_block(rows, columns)
            images.put(rows, columns, images_here)
        return images.join()

    def _blocks(self, inputs: SurfelInputs, camera: Camera, settings: RasterSettings) -> Iterator[_Block]:
        inputs, camera = inputs.checked(), camera.to(inputs.means)
        projected = project(inputs, camera, settings)
        for rows, columns in _squares(camera):
            yield self._block(projected, rows, columns, settings)

    def _block(self, projected: ProjectedSurfels, rows: slice, columns: slice, settings: RasterSettings) -> _Block:
        like = projected.depth
        ys = torch.arange(rows.start, rows.stop, dtype=like.dtype, device=like.device) + 0.5
        xs = torch.arange(columns.start, columns.stop, dtype=like.dtype, device=like.device) + 0.5
        pixels = torch.stack(torch.meshgrid(xs, ys, indexing="xy"), dim=-1).reshape(-1, 2)
        chosen = on_screen(projected, columns.start, rows.start, columns.stop, rows.stop).nonzero()[:, 0]
        hit = hits(projected, chosen, pixels, settings.near, self.smooth_cutoff)
        after = torch.cumprod(1.0 - hit.alpha, dim=-1)
        before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], dim=-1)[:, : after.shape[1]]
        # ``after`` never grows: the Gaussian that would take it below the bound and all behind it do not count.
        counted = after.detach() >= MIN_TRANSMITTANCE
        weights = torch.where(counted, hit.alpha * before, torch.zeros_like(before))
        remaining = torch.where(counted, 1.0 - hit.alpha, torch.ones_like(before)).prod(dim=-1)
        after = torch.where(counted, after, torch.ones_like(after))
        return _Block(rows, columns, projected.index[chosen], chosen, weights, hit.depth, remaining, before, after)


def _squares(camera: Camera) -> Iterator[tuple[slice, slice]]:
    """Yield the image cut into squares, row by row: slices of its rows and columns."""
    for y in range(0, camera.height, BLOCK):
        for x in range(0, camera.width, BLOCK):
            yield slice(y, min(y + BLOCK, camera.height)), slice(x, min(x + BLOCK, camera.width))


def _autograd_bytes(projected: ProjectedSurfels, camera: Camera) -> float:
    """Estimate the memory that autograd keeps of a render, from the blocks that each Gaussian's box meets."""
    low, high = projected.box.clamp_min(0.0).unflatten(1, (2, 2)).unbind(1)
    high = torch.minimum(high, high.new_tensor([camera.width, camera.height]))
    sides = ((high / BLOCK).ceil() - (low / BLOCK).floor()).clamp_min(0.0) * BLOCK
    pairs = float(sides.double().prod(dim=-1).sum())
    return pairs * KEPT_PER_PAIR * projected.depth.element_size()


def _composite(
    block: _Block,
    inputs: SurfelInputs,
    projected: ProjectedSurfels,
    settings: RasterSettings,
    background: Tensor,
    target: Tensor | None,
) -> dict[str, Tensor]:
    """Return all outputs of a block's P pixels, [P, channels] each (E4)."""
    w = block.weights
    alpha = w.sum(dim=-1, keepdim=True)
    images = {
        "color": w @ inputs.colors[block.index] + block.remaining[:, None] * background,
        "alpha": alpha,
    }
    if settings.geometry:
        images["normal"] = w @ projected.normal[block.chosen]
        nothing = alpha <= 0
        depth = (w * block.depth).sum(dim=-1, keepdim=True) / torch.where(nothing, torch.ones_like(alpha), alpha)
        images["depth"] = depth
        passes = (w > 0) & (block.before > 0.5) & (block.after <= 0.5)
        images["median"] = torch.where(passes, block.depth, torch.zeros_like(w)).sum(dim=-1, keepdim=True)
    if settings.distortion:
        m = settings.far / (settings.far - settings.near) * (1.0 - settings.near / block.depth)
        # sum_{j<i} w_i w_j (m_i - m_j)^2 follows from sums over all nearer surfels.
        terms = [w * m**power for power in range(3)]
        w0, w1, w2 = (torch.cumsum(term, dim=-1) - term for term in terms)
        images["distortion"] = (w * (m * m * w0 - 2.0 * m * w1 + w2)).sum(dim=-1, keepdim=True)
    if target is not None:
        assert inputs.class_ids is not None
        labels = target[block.rows, block.columns].reshape(-1, 1)
        wrong = (inputs.class_ids[block.index][None] != labels) & (labels != IGNORE)
        images["boundary"] = (w * wrong.to(w)).sum(dim=-1, keepdim=True)  # (E7)
    return images


class _Rows:
    """Joins square blocks into images, without writing into tensors that autograd watches."""

    def __init__(self) -> None:
        self._rows: dict[str, list[list[Tensor]]] = {}

    def put(self, rows: slice, columns: slice, images: dict[str, Tensor]) -> None:
        """Add a block; blocks come row by row, left to right."""
        shape = (rows.stop - rows.start, columns.stop - columns.start, -1)
        for name, image in images.items():
            lines = self._rows.setdefault(name, [])
            if columns.start == 0:
                lines.append([])
            lines[-1].append(image.reshape(shape))

    def join(self) -> dict[str, Tensor]:
        """Return the images, [H, W, channels] each."""
        return {name: torch.cat([torch.cat(row, dim=1) for row in rows]) for name, rows in self._rows.items()}
