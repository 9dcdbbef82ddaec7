"""Run by Blender: import a GLB with one animation and export it as FBX, or convert an FBX to GLB. `fbx.py` starts it.

    python fbx_export.py IN.glb OUT.fbx RATE NAME
    blender --background --factory-startup --python fbx_export.py -- IN.glb OUT.fbx RATE NAME
    python fbx_export.py IN.fbx OUT.glb

The motion of all bones is sampled in every frame, at the rate of the take. No bones are added at the ends of limbs. The FBX is
imported again, and the heads of its bones are compared with those of the GLB.
"""

import importlib
import sys
from fractions import Fraction
from math import atan2, cos, dist, remainder, sin, tau
from typing import Any

MAX_RATE_DENOMINATOR = 1001  # of a rate such as 60000/1001 Hz
MAX_BLENDER_FPS = 32767
MAX_DISTANCE_M = 1e-4  # of a bone's head in the FBX from that in the GLB


def export_fbx(source: str, target: str, rate: float, name: str) -> str:
    """Import a GLB into an empty scene at `rate` frames per second, and export it as FBX with an animation of a name.

    Returns what is wrong with the FBX, imported again, as the end of a sentence; "" if nothing is.
    """
    bpy = import_blender()
    keep_rotations_exact(importlib.import_module("io_scene_fbx.fbx_utils").ObjectWrapper)
    scene = open_empty_scene(bpy, rate)
    bpy.ops.import_scene.gltf(filepath=source, disable_bone_shape=True)
    scene.name = name  # the exporter names the animation after it
    ranges = [action.frame_range for action in bpy.data.actions]
    scene.frame_start = round(min((each[0] for each in ranges), default=0))
    scene.frame_end = round(max((each[1] for each in ranges), default=0))
    frame_count = scene.frame_end - scene.frame_start + 1
    expected = read_bone_heads(bpy, scene.frame_start, frame_count)
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
        path_mode="COPY",
        embed_textures=True,
    )
    open_empty_scene(bpy, rate)
    bpy.ops.import_scene.fbx(filepath=target)
    first = min((action.frame_range[0] for action in bpy.data.actions), default=0.0)
    return find_difference(expected, read_bone_heads(bpy, round(first), frame_count))


def import_fbx(source: str, target: str) -> None:
    """Convert an FBX to GLB: meshes, bones and animations."""
    bpy = import_blender()
    open_empty_scene(bpy, 30.0)
    bpy.ops.import_scene.fbx(filepath=source)
    bpy.ops.export_scene.gltf(filepath=target, export_format="GLB")


def import_blender() -> Any:
    """Return Blender's module with the add-ons for both formats."""
    bpy: Any = importlib.import_module("bpy")
    for addon in ("io_scene_gltf2", "io_scene_fbx"):
        bpy.ops.preferences.addon_enable(module=addon)
    return bpy


def keep_rotations_exact(wrapper: Any) -> None:
    """Let the class of the exporter that converts rotations to Euler angles give the last one by the others, in double precision.

    Blender computes the three separately in single precision. Near gimbal lock their errors of a milliradian do not cancel: half
    a millimetre at the fingers.
    """
    convert = wrapper.fbx_object_tx

    def convert_exactly(self: Any, *arguments: Any, **options: Any) -> tuple[Any, ...]:
        location, euler, *others = convert(self, *arguments, **options)
        w, x, y, z = others[1].decompose()[1]
        rows = (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)), (
            2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        )  # fmt: skip
        turned = cos(euler.y), sin(euler.y) * sin(euler.x), sin(euler.y) * cos(euler.x)
        cosine, sine = (sum(a * b for a, b in zip(row, turned, strict=True)) for row in rows)
        euler.z += remainder(atan2(sine, cosine) - euler.z, tau)
        return location, euler, *others

    wrapper.fbx_object_tx = convert_exactly


def open_empty_scene(bpy: Any, rate: float) -> Any:
    """Return a new scene without objects, at `rate` frames per second; the add-ons stay enabled."""
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    scene = bpy.context.scene
    scene.render.fps, scene.render.fps_base = split_rate(rate)
    return scene


def read_bone_heads(bpy: Any, first: int, count: int) -> dict[str, list[tuple[float, ...]]]:
    """Return where each bone's head is in the world in each of some frames, in metres."""
    armatures = [each for each in bpy.context.scene.objects if each.type == "ARMATURE"]
    heads: dict[str, list[tuple[float, ...]]] = {bone.name: [] for each in armatures for bone in each.pose.bones}
    for frame in range(first, first + count):
        bpy.context.scene.frame_set(frame)
        for each in armatures:
            for bone in each.pose.bones:
                heads[bone.name].append(tuple(each.matrix_world @ bone.head))
    return heads


def find_difference(expected: dict[str, list[tuple[float, ...]]], found: dict[str, list[tuple[float, ...]]]) -> str:
    """Return which bone is farthest from its place, as the end of a sentence; "" if all are near theirs."""
    if missing := expected.keys() - found.keys():
        return f"it lacks the bone {min(missing)}"
    distances = [
        (dist(*pair), name, frame)
        for name in expected
        for frame, pair in enumerate(zip(expected[name], found[name], strict=True))
    ]
    worst, name, frame = max(distances, default=(0.0, "", 0))
    return f"its bone {name} is {1e3 * worst:.1f} mm from that of the GLB in frame {frame + 1}" if worst > MAX_DISTANCE_M else ""


def split_rate(rate: float) -> tuple[int, float]:
    """Return a rate as Blender stores it: a whole number of frames per `fps_base` seconds."""
    fraction = Fraction(rate).limit_denominator(MAX_RATE_DENOMINATOR)
    if fraction.denominator == 1 and fraction.numerator <= MAX_BLENDER_FPS:
        return max(fraction.numerator, 1), 1.0
    fps = min(max(round(rate), 1), MAX_BLENDER_FPS)
    return fps, fps / rate


if __name__ == "__main__":
    arguments = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]
    if len(arguments) == 2:
        import_fbx(*arguments)
    elif difference := export_fbx(arguments[0], arguments[1], float(arguments[2]), arguments[3]):
        sys.exit(difference)
