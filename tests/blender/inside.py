"""Run by Blender's Python: import each file and return the positions of its bones. Jobs and answers are JSON files."""

import json
import sys
from pathlib import Path

import bpy  # pyright: ignore[reportMissingImports]


def imported(path: str, scale: float):
    """Import a file into a new scene at Blender's default of 24 frames per second; return its armature."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    if path.endswith(".glb"):
        bpy.ops.import_scene.gltf(filepath=path)
    else:
        bpy.ops.preferences.addon_enable(module="io_anim_bvh")
        bpy.ops.import_anim.bvh(filepath=path, global_scale=scale, update_scene_fps=True)
    return next(each for each in bpy.data.objects if each.type == "ARMATURE")


def heads(armature, at: list[float]) -> list[dict[str, list[float]]]:
    """Return the position of the head of each bone at frames of the scene."""
    found = []
    for frame in at:
        bpy.context.scene.frame_set(int(frame), subframe=frame - int(frame))
        found.append({bone.name: list(armature.matrix_world @ bone.head) for bone in armature.pose.bones})
    return found


def answer(job: dict) -> dict:
    """Return the heads at the given times (seconds after the first frame), the frame rate and the time of the last key."""
    armature, render = imported(job["path"], job["scale"]), bpy.context.scene.render
    rate, first = render.fps / render.fps_base, 0 if job["path"].endswith(".glb") else 1
    last = armature.animation_data.action.frame_range[1]
    return {
        "rate": rate,
        "last": (last - first) / rate,
        "meshes": sum(each.type == "MESH" and bool(each.modifiers) for each in bpy.data.objects),
        "rest": {bone.name: list(armature.matrix_world @ bone.head_local) for bone in armature.data.bones},
        "heads": heads(armature, [first + moment * rate for moment in job["moments"]]),
    }


if __name__ == "__main__":
    jobs, target = map(Path, sys.argv[1:])
    target.write_text(json.dumps([answer(job) for job in json.loads(jobs.read_text(encoding="utf-8"))]), encoding="utf-8")
