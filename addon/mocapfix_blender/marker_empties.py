"""The markers of a take as animated empties in a collection of their own.

A missing sample hides its empty. A sample that mocapfix estimated shows it as a sphere, and its custom property `filled` is 1.
"""

import bpy
import numpy as np

from .keyframes import TAKE_PROPERTY, ActionWriter, select_changes
from .solved_take import SolvedTake

LABEL_PROPERTY = "mocapfix_marker"
MARKER_SIZE_M = 0.012
DISPLAY_TYPES = {"measured": "PLAIN_AXES", "filled": "SPHERE"}


def build_markers(
    context, take: SolvedTake, take_key: str, armature: bpy.types.Object | None, frames: np.ndarray, actions: ActionWriter
) -> bpy.types.Object:
    """Make the empties of the markers, or update those of an earlier import; return the object that carries them.

    Args:
        armature: That of the take, which carries them, so that they follow it.
        frames: (F,) frames of the scene.
    """
    root = _find_root(context, take, take_key)
    if armature is not None:
        root.parent = armature
    collection = root.users_collection[0]
    existing = {each[LABEL_PROPERTY]: each for each in bpy.data.objects if each.parent == root and LABEL_PROPERTY in each}
    for label in existing.keys() - set(take.labels):
        bpy.data.objects.remove(existing[label])
    for m, label in enumerate(take.labels):
        empty = existing.get(label) or _add_marker(collection, root, label)
        _key_marker(empty, take.markers[:, m], take.is_filled[:, m], frames, actions)
    return root


def find_markers_root(take_key: str) -> bpy.types.Object | None:
    """Return the object that carries the markers of an earlier import of the take."""
    for each in bpy.data.objects:
        if each.type == "EMPTY" and each.get(TAKE_PROPERTY) == take_key and each.library is None:
            return each
    return None


def _find_root(context, take: SolvedTake, take_key: str) -> bpy.types.Object:
    root = find_markers_root(take_key)
    if root is None:
        collection = bpy.data.collections.new(f"{take.name} markers")
        context.scene.collection.children.link(collection)
        root = bpy.data.objects.new(f"{take.name} markers", None)
        root[TAKE_PROPERTY] = take_key
        root.empty_display_size = 0.1
        collection.objects.link(root)
    return root


def _add_marker(collection: bpy.types.Collection, root: bpy.types.Object, label: str) -> bpy.types.Object:
    empty = bpy.data.objects.new(label, None)
    empty[LABEL_PROPERTY] = label
    empty.parent = root
    empty.empty_display_size = MARKER_SIZE_M
    collection.objects.link(empty)
    return empty


def _key_marker(
    empty: bpy.types.Object, positions: np.ndarray, is_filled: np.ndarray, frames: np.ndarray, actions: ActionWriter
) -> None:
    """Write the keys of one marker: positions (F, 3) in metres, NaN where missing."""
    is_missing = np.asarray(np.isnan(positions).any(axis=1))
    empty["filled"] = 0
    keys = actions.assign(empty)
    keys.write("location", frames, positions, group="marker")
    for path, states in (("hide_viewport", is_missing), ("hide_render", is_missing)):
        if states.any():
            changes = select_changes(states)
            keys.write(path, frames[changes], states[changes].astype(float), group="marker", interpolation="CONSTANT")
    empty.hide_viewport = empty.hide_render = False
    empty.empty_display_type = DISPLAY_TYPES["measured"]
    if is_filled.any():
        changes = select_changes(is_filled)
        enumeration = empty.bl_rna.properties["empty_display_type"].enum_items
        codes = np.array([float(enumeration[DISPLAY_TYPES[state]].value) for state in ("measured", "filled")])
        filled = is_filled[changes].astype(int)
        keys.write('["filled"]', frames[changes], filled.astype(float), group="marker", interpolation="CONSTANT")
        keys.write("empty_display_type", frames[changes], codes[filled], group="marker", interpolation="CONSTANT")
