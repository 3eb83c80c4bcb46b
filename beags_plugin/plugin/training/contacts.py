"""Close objects where other objects hid them: the last change of a refinement."""

from __future__ import annotations

from collections.abc import Callable

import torch

from beags_plugin.core.densification import Densified
from beags_plugin.core.membership import Membership
from beags_plugin.labels.label_maps import LabelMaps
from beags_plugin.plugin.training.scene_model import SceneModel
from beags_plugin.plugin.views.datamanager import BeagsDataManager
from beags_plugin.preparation.refiner_training import Edit
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.surfaces.closing_gaussians import joined
from beags_plugin.surfaces.contact_faces import contact_faces
from beags_plugin.surfaces.item import Viewpoints
from beags_plugin.surfaces.mesh_options import MeshOptions

MOST_VIEWS = 30  # Views rendered for each object, evenly spaced.
RESOLUTION = 96  # Voxels along an object's longest side.


@torch.no_grad()
def close_contacts(
    model: SceneModel, datamanager: BeagsDataManager, progress: Callable[[int, int], None]
) -> tuple[Edit, str]:
    """Return the edit that adds the Gaussians of ``surfaces.contact_faces``, and a line that counts them.

    Everything runs on the CPU, as meshing does. progress: receives (done, total).
    """
    views = datamanager.views("train")
    chosen = [views[index] for index in range(0, len(views), -(-len(views) // MOST_VIEWS))]
    scene = model.surfels().detach().to("cpu")
    class_ids = model.class_ids.cpu()
    rasterizer = model.rasterizer if model.device.type == "cpu" else make_rasterizer()
    faces = contact_faces(
        scene,
        Membership(class_ids),
        model.classes,
        Viewpoints([view.camera.to("cpu") for view in chosen], rasterizer, model.settings()),
        LabelMaps(view.labels for view in chosen),
        MeshOptions(resolution=RESOLUTION),
        progress,
    )
    added = [int((faces.class_ids == class_id).sum()) for class_id in model.classes]
    counts = ", ".join(f"{count} of {name}" for count, name in zip(added, model.classes.values(), strict=True) if count)
    line = f"closed where neighbours hide objects: {counts} Gaussians added" if counts else "no contact to close"
    device, own = model.device, torch.arange(len(scene))
    # Each new Gaussian takes its class from a Gaussian of the same object.
    lenders = {class_id: int((class_ids == class_id).int().argmax()) for class_id in faces.class_ids.unique().tolist()}
    source = torch.cat([own, torch.tensor([lenders[each] for each in faces.class_ids.tolist()], dtype=torch.int64)])
    edited = Densified(
        joined(scene, faces.surfels).to(device),
        source.to(device),
        (torch.arange(len(source)) >= len(own)).to(device),
    )
    return Edit(edited=edited) if len(faces.surfels) else Edit(), line
