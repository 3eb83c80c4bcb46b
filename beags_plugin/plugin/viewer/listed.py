"""The classes that a viewer lists: those that have Gaussians, under their present names."""

from __future__ import annotations

from beags_plugin.plugin.training.scene_model import SceneModel
from beags_plugin.plugin.viewer.legend import unique_labels


class Listed:
    """The list. labels: unique label to class id, ascending. counts: class id to number of Gaussians."""

    def __init__(self) -> None:
        self.labels: dict[str, int] = {}
        self.counts: dict[int, int] = {}
        self._key: tuple | None = None

    def refresh(self, model: SceneModel) -> bool:
        """Update the list if the model's classes have changed; return whether they have."""
        ids = model.class_ids
        assigned, names = bool(model.assigned), tuple(model.classes.items())
        key = (assigned, ids.data_ptr(), len(ids), ids._version, id(model.objects), names)
        if key == self._key:
            return False
        members = model.members()
        self.counts = {c: int(members.of(c).sum()) for c in members.present()} if assigned else {}
        self.labels = unique_labels({class_id: model.classes.get(class_id, "") for class_id in self.counts})
        self._key = key
        return True
