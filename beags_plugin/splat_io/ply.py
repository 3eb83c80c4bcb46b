"""Gaussian splats as .ply files, in the layout that 3DGS and 2DGS viewers read."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from beags_plugin.core.rotations import rotation_from_quat
from beags_plugin.core.sh import MAX_DEGREE, num_sh_bases
from beags_plugin.core.surfels import Surfels
from beags_plugin.splat_io.files import whole_file
from beags_plugin.splat_io.frames import to_input_frame
from beags_plugin.splat_io.splat_file import numbered
from beags_plugin.system.reading.ply import write_vertices

DISC_COMMENT = "SplatRenderMode: 2dgs"
"""Comment of .ply files whose Gaussians are discs; PlayCanvas' programs and Brush read it."""
THICKNESS = 1e-3
"""Third scale in files, relative to the smaller of the two: flat, yet no viewer divides by 0."""


def write_ply(
    path: str | Path,
    surfels: Surfels,
    class_ids: Tensor | None = None,
    transform: tuple[Tensor, float] | None = None,
    layout: Literal["3dgs", "2dgs"] = "3dgs",
    invented: Tensor | None = None,
) -> None:
    """Write Gaussians as a binary splat .ply: columns of 3DGS or 2DGS, and ``class_id`` (int32) if there are class ids.

    Columns: x y z; nx ny nz, the Gaussian's normal; f_dc_0..2; f_rest_* channel-major (red, then green, then blue);
    opacity as a logit; scale_0..2 as logs, the third ``THICKNESS`` times the smaller of the two for viewers of 3D
    Gaussians; rot_0..3 wxyz, unit length. The layout of 2DGS has two scales, 45 f_rest columns padded with 0, because
    the official code expects SH degree 3, and a comment for PlayCanvas' programs.

    surfels: N Gaussians. class_ids: [N] integer, phi. transform: the dataparser's ([3, 4], scale); with it the
    file is in the frame of the input poses, without it in the Gaussians' own. invented: [N] bool, the last column, of
    uchar 0 or 1. Raises ``UserError`` if the file cannot be written.
    """
    if transform is not None:
        surfels = to_input_frame(surfels, *transform)
    columns = _columns(surfels, layout)
    if class_ids is not None:
        if class_ids.shape != (len(surfels),):
            raise ValueError(f"class_ids must be [{len(surfels)}], not {list(class_ids.shape)}")
        columns["class_id"] = class_ids.detach().cpu().numpy().astype("<i4")
    if invented is not None:
        columns["invented"] = invented.cpu().numpy().astype("u1")
    table = np.empty(len(surfels), dtype=[(name, values.dtype) for name, values in columns.items()])
    for name, values in columns.items():
        table[name] = values
    with whole_file(path) as part, open(part, "wb") as file:
        write_vertices(file, table, DISC_COMMENT if layout == "2dgs" else "")


def thin_log_scales(log_scales: Tensor) -> Tensor:
    """Return log scales [N, 2] as those of 3D Gaussians, [N, 3]: the third is ``THICKNESS`` times the smaller one."""
    return torch.cat([log_scales, log_scales.amin(dim=-1, keepdim=True) + math.log(THICKNESS)], dim=-1)


def _columns(surfels: Surfels, layout: str) -> dict[str, np.ndarray]:
    quats = torch.nn.functional.normalize(surfels.quats.detach(), dim=-1)
    normals = rotation_from_quat(quats)[:, :, 2]
    log_scales = surfels.log_scales.detach()
    scales = thin_log_scales(log_scales) if layout == "3dgs" else log_scales
    rest = surfels.sh_rest.detach()
    if layout == "2dgs":
        rest = torch.cat([rest, rest.new_zeros(len(rest), num_sh_bases(MAX_DEGREE) - 1 - rest.shape[1], 3)], dim=1)
    rest = rest.transpose(1, 2).flatten(1)  # channel-major
    blocks = {
        ("x", "y", "z"): surfels.means.detach(),
        ("nx", "ny", "nz"): normals,
        numbered("f_dc", 3): surfels.sh_dc.detach(),
        numbered("f_rest", rest.shape[1]): rest,
        ("opacity",): surfels.opacity_logits.detach()[:, None],
        numbered("scale", scales.shape[1]): scales,
        numbered("rot", 4): quats,
    }
    return {
        name: values[:, i].cpu().numpy().astype("<f4")
        for names, values in blocks.items()
        for i, name in enumerate(names)
    }
