"""The panel in the sidebar of the 3-D view, the entry in the Object menu, and their settings."""

from pathlib import Path

import bpy
from bpy_extras.io_utils import ExportHelper

from .clean_arguments import DEFAULT_FEET, FEET_ITEMS
from .keyframes import TAKE_PROPERTY
from .retarget_operator import MOCAPFIX_OT_retarget, get_mapping, get_mapping_text_name

SETTING_NAMES = ("mapping_file", "subject", "frame_rate", "set_scene", "start_frame", "feet", "keep_files", "options")
"""settings that the operator has too"""


class MocapfixSettings(bpy.types.PropertyGroup):
    """What the panel retargets, saved with the scene."""

    take: bpy.props.StringProperty(
        name="Take", description="Motion capture file; empty: that of the selected or only imported armature", subtype="FILE_PATH"
    )
    subject: bpy.props.StringProperty(name="Subject", description="One of several subjects of the take: Jim of Jim:LFHD")
    mapping_file: bpy.props.StringProperty(
        name="Mapping",
        description="Edited mapping (YAML) of the character's bones; empty: found by mocapfix",
        subtype="FILE_PATH",
    )
    frame_rate: bpy.props.FloatProperty(
        name="Frame rate", description="Frames per second of the motion; 0: those of the take", default=0.0, min=0.0, max=1000.0
    )
    set_scene: bpy.props.BoolProperty(name="Set the scene's rate and range", default=True)
    start_frame: bpy.props.IntProperty(name="Start frame", default=1)
    feet: bpy.props.EnumProperty(name="Feet", items=FEET_ITEMS, default=DEFAULT_FEET)
    keep_files: bpy.props.BoolProperty(
        name="Keep the cleaned files", description="Write all files into TAKE.mocapfix beside the take", default=False
    )
    options: bpy.props.StringProperty(name="Options", description="More options of `mocapfix clean`, for example --up Z")


class MOCAPFIX_OT_save_mapping(bpy.types.Operator, ExportHelper):
    """Save the mapping of the active armature, with edits in the text editor, and use it from now on"""

    bl_idname = "mocapfix.save_mapping"
    bl_label = "Save mapping"
    filename_ext = ".yaml"
    filter_glob: bpy.props.StringProperty(default="*.yaml", options={"HIDDEN"})

    def execute(self, context) -> set[str]:
        """Write the file and put it into the panel's field."""
        text = None if context.object is None else bpy.data.texts.get(get_mapping_text_name(context.object))
        if text is None:
            self.report({"ERROR"}, "The active object has no mapping; retarget a take onto it first.")
            return {"CANCELLED"}
        try:
            Path(self.filepath).write_text(text.as_string(), encoding="utf-8")
        except OSError as error:
            self.report({"ERROR"}, f"{self.filepath} cannot be written ({error.strerror}); choose another folder.")
            return {"CANCELLED"}
        context.scene.mocapfix.mapping_file = self.filepath
        return {"FINISHED"}


class MOCAPFIX_PT_retarget(bpy.types.Panel):
    """Retargeting onto the selected armature"""

    bl_label = "Retarget"
    bl_category = "mocapfix"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"

    def draw(self, context) -> None:
        """Draw the settings, the button and the mapping."""
        layout, settings = self.layout, context.scene.mocapfix
        layout.use_property_split = True
        for name in ("take", *SETTING_NAMES):
            layout.prop(settings, name)
        draw_retarget_button(layout, context)
        armature = context.object
        if armature is None or armature.type != "ARMATURE" or not (mapping := get_mapping(armature)):
            return
        box = layout.box()
        box.label(text=f"Mapping of {armature.name}")
        grid = box.column(align=True)
        for segment, bones in mapping.items():
            row = grid.split(factor=0.4)
            row.label(text=segment.replace("_", " "))
            row.label(text=", ".join(bones))
        box.operator(MOCAPFIX_OT_save_mapping.bl_idname)


def find_imported_take(context) -> str:
    """Return the take of the panel, else that of a selected imported armature or the only one in the scene; "" without one."""
    if context.scene.mocapfix.model.take:
        return context.scene.mocapfix.model.take
    for objects in (context.selected_objects, context.scene.objects):
        takes = {each[TAKE_PROPERTY].split("\t")[0] for each in objects if each.type == "ARMATURE" and TAKE_PROPERTY in each}
        if len(takes) == 1:
            return takes.pop()
    return ""


def draw_retarget_button(layout, context) -> None:
    """Draw the button with the settings of the panel."""
    settings = context.scene.mocapfix
    operator = layout.operator(MOCAPFIX_OT_retarget.bl_idname)
    operator.filepath = find_imported_take(context)
    for name in SETTING_NAMES:
        setattr(operator, name, getattr(settings, name))


def draw_object_menu(menu, context) -> None:
    """Add the operator to the Object menu."""
    menu.layout.separator()
    draw_retarget_button(menu.layout, context)
