"""Keys in actions: with slots from Blender 4.4 on, one action for each object before."""

import bpy
import numpy as np

INTERPOLATION_CODES = {"CONSTANT": 0, "LINEAR": 1}
"""values of the enumeration in keyframe points"""
HAS_SLOTS = bpy.app.version >= (4, 4, 0)
TAKE_PROPERTY = "mocapfix_take"
"""custom property of what belongs to a take: its file, and its subject after a tab"""
ROLE_PROPERTY = "mocapfix_role"
"""custom property of an action: the name that it had at first"""


class ActionWriter:
    """Replaces the keys of the action of one kind ("motion", "markers") of a take; objects share it where actions have slots."""

    def __init__(self, name: str, take_key: str) -> None:
        """Find the actions that an earlier import has made, or make new ones."""
        self._name, self._take_key = name, take_key
        self._cleared: set[bpy.types.Action] = set()

    def assign(self, owner: bpy.types.Object) -> "KeyWriter":
        """Make an object use the action, with no keys yet; return what writes its keys."""
        data = owner.animation_data or owner.animation_data_create()
        action = self._find_action(self._name) if HAS_SLOTS else self._find_own_action(owner)
        if action not in self._cleared:
            _clear_action(action)
            self._cleared.add(action)
        if data.action is not None and data.action != action and data.action.users == 1:
            data.action.use_fake_user = True  # the user's own action stays
        slot = data.action_slot if HAS_SLOTS and data.action == action else None
        data.action = action
        if not HAS_SLOTS:
            return KeyWriter(action.fcurves, uses_groups=True)
        slot = slot or action.slots.get(f"OB{owner.name}") or action.slots.new(id_type="OBJECT", name=owner.name)
        data.action_slot = slot
        layer = action.layers[0] if action.layers else action.layers.new("Layer")
        strip = layer.strips[0] if layer.strips else layer.strips.new(type="KEYFRAME")
        return KeyWriter(strip.channelbag(slot, ensure=True).fcurves, uses_groups=False)

    def _find_own_action(self, owner: bpy.types.Object) -> bpy.types.Action:
        """Return the action of one object, which may have another name by now."""
        action = owner.animation_data.action
        if action is not None and action.get(TAKE_PROPERTY) == self._take_key and action[ROLE_PROPERTY].startswith(self._name):
            return action
        return self._find_action(f"{self._name} {owner.name}")

    def _find_action(self, name: str) -> bpy.types.Action:
        for action in bpy.data.actions:
            if action.library is None and action.get(TAKE_PROPERTY) == self._take_key and action.get(ROLE_PROPERTY) == name:
                return action
        action = bpy.data.actions.new(name)
        action[TAKE_PROPERTY], action[ROLE_PROPERTY] = self._take_key, name
        return action


class KeyWriter:
    """Writes the keys of one object."""

    def __init__(self, fcurves, *, uses_groups: bool) -> None:
        self._fcurves = fcurves
        self._group_option = "action_group" if uses_groups else "group_name"

    def write(self, data_path: str, frames: np.ndarray, values: np.ndarray, *, group: str, interpolation: str = "LINEAR") -> None:
        """Write the keys of a property of C components.

        Args:
            frames: (T,) frames of the scene, not necessarily whole.
            values: (T, C), or (T,) for a property of one component; frames in which a value is not finite get no key.
        """
        is_single = values.ndim == 1
        values = values.reshape(len(frames), -1)
        is_finite = np.isfinite(values).all(1)
        if not is_finite.any():
            return
        frames, values = frames[is_finite], values[is_finite]
        points = np.empty((len(frames), 2), np.float32)
        points[:, 0] = frames
        codes = np.full(len(frames), INTERPOLATION_CODES[interpolation], np.int32)
        for component in range(values.shape[1]):
            options = {self._group_option: group} | ({} if is_single else {"index": component})
            curve = self._fcurves.new(data_path, **options)
            points[:, 1] = values[:, component]
            curve.keyframe_points.add(len(frames))
            curve.keyframe_points.foreach_set("co", points.ravel())
            curve.keyframe_points.foreach_set("interpolation", codes)
            curve.update()


def select_changes(values: np.ndarray) -> np.ndarray:
    """Return the indices at which a sequence of values (T, ...) takes another value, with the first."""
    changes = values[1:] != values[:-1]
    return np.concatenate([[0], 1 + np.flatnonzero(changes.reshape(len(changes), -1).any(1))])


def _clear_action(action: bpy.types.Action) -> None:
    """Remove all keys. Slots stay, since strips of the user's NLA may use them."""
    if not HAS_SLOTS:
        action.fcurves.clear()
        return
    for layer in action.layers:
        for strip in layer.strips:
            for channelbag in strip.channelbags:
                channelbag.fcurves.clear()
