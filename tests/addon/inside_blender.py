"""Run by Blender's Python: install the add-on, use its operators, and return what the scene has then.

Usage: inside_blender.py JOB ANSWERS, both JSON. A job is a list of steps; each is answered by a value.
"""

import json
import sys
from pathlib import Path
from types import SimpleNamespace

import bpy  # pyright: ignore[reportMissingImports]

ADDON = "bl_ext.user_default.mocapfix"


def install(archive: str, executable: str) -> bool:
    """Install the add-on from its zip file; return whether it is enabled."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.extensions.package_install_files(filepath=archive, repo="user_default", enable_on_install=True)
    set_executable(executable)
    return ADDON in bpy.context.preferences.addons


def set_executable(path: str) -> None:
    bpy.context.preferences.addons[ADDON].preferences.executable = path


def run_operator(name: str, **options) -> str:
    """Return the error that an operator reports, or the word that it returns."""
    try:
        return next(iter(getattr(bpy.ops.mocapfix, name)(**options)))
    except RuntimeError as error:
        return str(error).strip()


def clear_scene() -> None:
    bpy.ops.wm.read_homefile(use_factory_startup=True, use_empty=True)


def describe_scene(frames: list[int]) -> dict:
    """Return what is in the scene, and where bones and markers are in some frames."""
    scene = bpy.context.scene
    armatures = [each for each in bpy.data.objects if each.type == "ARMATURE"]
    poses: list[dict] = []
    answer = {
        "rate": scene.render.fps / scene.render.fps_base,
        "range": [scene.frame_start, scene.frame_end],
        "armatures": {each.name: describe_armature(each) for each in armatures},
        "actions": sorted(each.name for each in bpy.data.actions),
        "collections": {each.name: [object.name for object in each.objects] for each in bpy.data.collections},
        "timeline": sorted((each.frame, each.name) for each in scene.timeline_markers),
        "texts": {each.name: each.as_string() for each in bpy.data.texts},
        "objects": len(bpy.data.objects),
        "frames": poses,
    }
    for frame in frames:
        scene.frame_set(frame)
        empties = [each for each in bpy.data.objects if "mocapfix_marker" in each]
        poses.append({
            "heads": {each.name: read_heads(each) for each in armatures},
            "markers": {each["mocapfix_marker"]: list(each.matrix_world.translation) for each in empties},
            "hidden": [each["mocapfix_marker"] for each in empties if each.hide_viewport],
            "filled": [each["mocapfix_marker"] for each in empties if each["filled"]],
            "spheres": [each["mocapfix_marker"] for each in empties if each.empty_display_type == "SPHERE"],
        })  # fmt: skip
    return answer


def describe_armature(armature) -> dict:
    data = armature.animation_data
    return {
        "bones": [bone.name for bone in armature.data.bones],
        "rest": {bone.name: list(armature.matrix_world @ bone.head_local) for bone in armature.data.bones},
        "matrix": [list(row) for row in armature.matrix_world],
        "action": data.action.name if data and data.action else None,
        "range": list(data.action.frame_range) if data and data.action else None,
        "constraints": [each.name for each in armature.constraints],
        "bone_constraints": [(bone.name, each.name) for bone in armature.pose.bones for each in bone.constraints],
        "note": armature.get("note"),
        "modes": {bone.name: bone.rotation_mode for bone in armature.pose.bones},
    }


def read_heads(armature) -> dict[str, list[float]]:
    return {bone.name: list(armature.matrix_world @ bone.head) for bone in armature.pose.bones}


def add_armature(name: str, bones: list, scale: float, rotation_x: float) -> None:
    """Add an armature with bones (name, parent, head, tail) and make it active."""
    armature = bpy.data.objects.new(name, bpy.data.armatures.new(name))
    bpy.context.collection.objects.link(armature)
    bpy.context.view_layer.objects.active = armature
    bpy.ops.object.mode_set(mode="EDIT")
    for bone_name, parent, head, tail in bones:
        bone = armature.data.edit_bones.new(bone_name)
        bone.head, bone.tail, bone.roll = head, tail, 0.7
        bone.parent = armature.data.edit_bones[parent] if parent else None
    bpy.ops.object.mode_set(mode="OBJECT")
    armature.scale, armature.rotation_euler = [scale] * 3, (rotation_x, 0.0, 0.0)
    bpy.context.view_layer.update()
    armature.select_set(True)


def run_code(code: str) -> object:
    """Run code of a test; return what it assigns to `answer`."""
    variables = {"bpy": bpy, "armature": next((each for each in bpy.data.objects if each.type == "ARMATURE"), None)}
    exec(code, variables)
    return variables.get("answer")


def run_modal(arguments: list[str], escape_after: int | None) -> dict:
    """Run the modal part of an operator as a window would, with a timer; press Esc after some events, unless None."""
    import importlib
    import time

    modules = {name: importlib.import_module(f"{ADDON}.{name}") for name in ("process", "process_operator", "preferences")}
    shown: list[str | None] = []
    reports: list[str] = []
    finished: list[bool] = []

    class Operator(modules["process_operator"].ProcessOperator):
        def report(self, _kind, text):
            reports.append(text)

        def finish(self, _context, process):
            finished.append(process.output_folder.is_dir())

    window_manager = SimpleNamespace(
        event_timer_add=lambda *_, **__: object(), event_timer_remove=lambda _: None, modal_handler_add=lambda _: None,
        progress_begin=lambda *_: None, progress_update=lambda value: shown.append(str(value)), progress_end=lambda: None,
    )  # fmt: skip
    context = SimpleNamespace(
        window_manager=window_manager, window=object(), preferences=bpy.context.preferences,
        workspace=SimpleNamespace(status_text_set=shown.append),
    )  # fmt: skip
    operator, temporary = Operator(), modules["process"].make_temporary_folder()
    operator.has_window = lambda _: True
    result, events = operator.start(context, arguments, temporary), 0
    while result & {"RUNNING_MODAL", "PASS_THROUGH"}:
        is_escape = escape_after is not None and events >= escape_after
        event = SimpleNamespace(type="ESC" if is_escape else "TIMER", value="PRESS" if is_escape else "NOTHING")
        result, events = operator.modal(context, event), events + 1
        time.sleep(0.05)
    return {
        "result": next(iter(result)), "shown": shown, "reports": reports, "finished": finished,
        "removed": not temporary.exists(),
    }  # fmt: skip


STEPS = {each.__name__: each for each in (
    install, set_executable, run_operator, clear_scene, describe_scene, add_armature, run_code, run_modal,
)}  # fmt: skip

if __name__ == "__main__":
    job, answers = map(Path, sys.argv[1:])
    results = {}
    for title, step, options in json.loads(job.read_text(encoding="utf-8")):
        results[title] = STEPS[step](**options)
    answers.write_text(json.dumps(results), encoding="utf-8")
