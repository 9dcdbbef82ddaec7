"""Blender add-on: import motion capture that an installed mocapfix has cleaned, and retarget it onto characters."""

import bpy

from .import_operator import MOCAPFIX_FH_take, MOCAPFIX_OT_import_take, draw_import_menu
from .panel import MOCAPFIX_OT_save_mapping, MOCAPFIX_PT_retarget, MocapfixSettings, draw_object_menu
from .preferences import MocapfixPreferences
from .retarget_operator import MOCAPFIX_OT_retarget

CLASSES = (
    MocapfixPreferences,
    MocapfixSettings,
    MOCAPFIX_OT_import_take,
    MOCAPFIX_FH_take,
    MOCAPFIX_OT_retarget,
    MOCAPFIX_OT_save_mapping,
    MOCAPFIX_PT_retarget,
)


def register() -> None:
    """Register the classes, the settings of scenes and the menu entries."""
    for each in CLASSES:
        bpy.utils.register_class(each)
    bpy.types.Scene.mocapfix = bpy.props.PointerProperty(type=MocapfixSettings)
    bpy.types.TOPBAR_MT_file_import.append(draw_import_menu)
    bpy.types.VIEW3D_MT_object.append(draw_object_menu)


def unregister() -> None:
    """Remove the menu entries, the settings and the classes."""
    bpy.types.VIEW3D_MT_object.remove(draw_object_menu)
    bpy.types.TOPBAR_MT_file_import.remove(draw_import_menu)
    del bpy.types.Scene.mocapfix
    for each in reversed(CLASSES):
        bpy.utils.unregister_class(each)
