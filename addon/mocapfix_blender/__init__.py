"""Blender add-on: import motion capture that an installed mocapfix has cleaned, and retarget it onto characters."""

import bpy

from .import_operator import MOCAPFIX_FH_take, MOCAPFIX_OT_import_take, draw_import_menu
from .preferences import MocapfixPreferences

CLASSES = (MocapfixPreferences, MOCAPFIX_OT_import_take, MOCAPFIX_FH_take)


def register() -> None:
    """Register the classes and the menu entries."""
    for each in CLASSES:
        bpy.utils.register_class(each)
    bpy.types.TOPBAR_MT_file_import.append(draw_import_menu)


def unregister() -> None:
    """Remove the menu entries and the classes."""
    bpy.types.TOPBAR_MT_file_import.remove(draw_import_menu)
    for each in reversed(CLASSES):
        bpy.utils.unregister_class(each)
