"""The classes that a viewer lists: those that have Gaussians, under the names that the model now has."""

from __future__ import annotations

from beags_plugin.plugin.training.scene_model import SceneModel
from beags_plugin.plugin.viewer.legend import unique_labels


class Listed:
    """What was listed last. labels: unique label to class id, ascending. counts: class id to number of Gaussians."""

    def __init__(self) -> None:
        self.labels: dict[str, int] = {}
        self.counts: dict[int, int] = {}
        self._key: tuple | None = None

    def refresh(self, model: SceneModel) -> bool:
        """List the classes of a model anew if they have changed; return whether they have."""
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
