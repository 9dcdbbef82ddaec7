"""Run by Blender: import a GLB with one animation and export it as FBX. `character_files.py` starts it in a process of its own.

    python fbx_export.py IN.glb OUT.fbx RATE NAME
    blender --background --factory-startup --python fbx_export.py -- IN.glb OUT.fbx RATE NAME

The motion is sampled in every frame, at the rate of the take. No bones are added at the ends of limbs.
"""

import importlib
import sys
from fractions import Fraction
from typing import Any

MAX_RATE_DENOMINATOR = 1001  # of a rate such as 60000/1001 Hz
MAX_BLENDER_FPS = 32767


def export_fbx(source: str, target: str, rate: float, name: str) -> None:
    """Import a GLB into an empty scene at `rate` frames per second, and export it as FBX with an animation of a name."""
    bpy: Any = importlib.import_module("bpy")
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.preferences.addon_enable(module="io_scene_gltf2")
    bpy.ops.preferences.addon_enable(module="io_scene_fbx")
    scene = bpy.context.scene
    scene.render.fps, scene.render.fps_base = split_rate(rate)
    bpy.ops.import_scene.gltf(filepath=source, disable_bone_shape=True)
    scene.name = name  # the exporter names the animation after it
    ranges = [action.frame_range for action in bpy.data.actions]
    scene.frame_start = round(min((each[0] for each in ranges), default=0))
    scene.frame_end = round(max((each[1] for each in ranges), default=0))
    bpy.ops.export_scene.fbx(
        filepath=target,
        add_leaf_bones=False,
        bake_anim=True,
        bake_anim_use_all_bones=True,
        bake_anim_use_nla_strips=False,
        bake_anim_use_all_actions=False,
        bake_anim_force_startend_keying=True,
        bake_anim_step=1.0,
        bake_anim_simplify_factor=0.0,
    )


def split_rate(rate: float) -> tuple[int, float]:
    """Return a rate as Blender stores it: a whole number of frames per `fps_base` seconds."""
    fraction = Fraction(rate).limit_denominator(MAX_RATE_DENOMINATOR)
    if fraction.denominator == 1 and fraction.numerator <= MAX_BLENDER_FPS:
        return max(fraction.numerator, 1), 1.0
    fps = min(max(round(rate), 1), MAX_BLENDER_FPS)
    return fps, fps / rate


if __name__ == "__main__":
    arguments = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]
    export_fbx(arguments[0], arguments[1], float(arguments[2]), arguments[3])
