"""The add-on's preferences: where mocapfix is installed."""

import bpy

from .process import ProcessError, find_executable


class MocapfixPreferences(bpy.types.AddonPreferences):
    """Preferences of the add-on."""

    bl_idname = __package__

    executable: bpy.props.StringProperty(
        name="mocapfix",
        description="Program mocapfix, for example bin/mocapfix of a virtual environment; empty: the one on the PATH",
        subtype="FILE_PATH",
    )

    def draw(self, _context) -> None:
        """Show the path, and whether there is a program."""
        self.layout.prop(self, "executable")
        try:
            self.layout.label(text=f"Found: {find_executable(bpy.path.abspath(self.executable))}", icon="CHECKMARK")
        except ProcessError as error:
            self.layout.label(text=str(error), icon="ERROR")


def get_executable(context) -> str:
    """Return the path of mocapfix. Raises ProcessError if it is not there."""
    given = context.preferences.addons[__package__].preferences.executable
    return find_executable(bpy.path.abspath(given) if given.startswith("//") else given)
