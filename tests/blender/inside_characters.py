"""Run by Blender's Python: import the written files of characters and return the positions of their bones."""

import json
import sys
from pathlib import Path

import bpy  # pyright: ignore[reportMissingImports]


def open_file(path: str, scale: float, rate: float):
    """Import a file into an empty scene; return its armature. Only BVH sets the rate of the scene."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    if path.endswith(".bvh"):
        bpy.ops.preferences.addon_enable(module="io_anim_bvh")
        bpy.ops.import_anim.bvh(filepath=path, global_scale=scale, update_scene_fps=True)
    elif path.endswith(".fbx"):
        bpy.ops.preferences.addon_enable(module="io_scene_fbx")
        bpy.ops.import_scene.fbx(filepath=path)
    elif path.endswith(".usdc"):
        bpy.ops.wm.usd_import(filepath=path)
    else:
        bpy.context.scene.render.fps = round(rate)
        bpy.ops.import_scene.gltf(filepath=path)
    return next(each for each in bpy.data.objects if each.type == "ARMATURE")


def read_ends(armature, frame: float, end: str) -> dict[str, list[float]]:
    """Return the heads or tails of the bones in the world, in metres, at a frame of the scene."""
    bpy.context.scene.frame_set(int(frame), subframe=frame - int(frame))
    return {bone.name: list(armature.matrix_world @ getattr(bone, end)) for bone in armature.pose.bones}


def answer(job: dict) -> dict:
    """Return heads and tails in some frames of the motion, the rate, and the number of frames."""
    armature, render = open_file(job["path"], job["scale"], job["rate"]), bpy.context.scene.render
    first, last = armature.animation_data.action.frame_range
    return {
        "rate": render.fps / render.fps_base,
        "first": first,
        "frames": last - first + 1,
        "action": armature.animation_data.action.name,
        "objects": sorted(each.type for each in bpy.context.scene.objects),
        "meshes": sum(each.type == "MESH" and bool(each.modifiers) for each in bpy.data.objects),
        **{f"{end}s": [read_ends(armature, first + frame, end) for frame in job["frames"]] for end in ("head", "tail")},
    }


if __name__ == "__main__":
    jobs, target = map(Path, sys.argv[1:])
    target.write_text(json.dumps([answer(job) for job in json.loads(jobs.read_text(encoding="utf-8"))]), encoding="utf-8")
