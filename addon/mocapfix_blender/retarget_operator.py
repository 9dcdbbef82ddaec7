"""Retarget a take onto the selected armature: its rest pose goes to mocapfix, the motion that comes from there becomes keys."""

import json
import shutil
import time
from pathlib import Path

import bpy
import numpy as np
from bpy_extras.io_utils import ImportHelper

from .armature import key_pose_bone
from .character_file import BoneMotion, get_character_name, get_object_scale, read_bone_motion, write_character
from .clean_arguments import DEFAULT_FEET, FEET_ITEMS, build_arguments, get_output_folder, resolve_take
from .keyframes import TAKE_PROPERTY, ActionWriter, KeyWriter
from .process import CleaningProcess, ProcessError, make_temporary_folder
from .process_operator import ProcessOperator
from .solved_take import read_subject
from .timeline import compute_scene_frames, set_rate_and_range

MAPPING_PROPERTY = "mocapfix_mapping"
"""custom property of a retargeted armature: the bones of each segment of its body, as JSON"""
RIGIFY_PROPERTY = "rig_id"
"""custom property of the armatures that Rigify generates"""
MAX_NAMED_BONES = 3


class MOCAPFIX_OT_retarget(ProcessOperator, bpy.types.Operator, ImportHelper):
    """Clean a take and put its motion onto the selected armature, as a new action"""

    bl_idname = "mocapfix.retarget"
    bl_label = "Retarget take onto armature"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    filter_glob: bpy.props.StringProperty(default="*.c3d;*.trc;*.csv;*.bvh", options={"HIDDEN"})
    mapping_file: bpy.props.StringProperty(
        name="Mapping",
        description="YAML file with the bones of the body's segments; empty: found by mocapfix",
        subtype="FILE_PATH",
    )
    subject: bpy.props.StringProperty(name="Subject", description="One of several subjects of the take: Jim of Jim:LFHD")
    frame_rate: bpy.props.FloatProperty(
        name="Frame rate", description="Frames per second of the motion; 0: those of the take", default=0.0, min=0.0, max=1000.0
    )
    set_scene: bpy.props.BoolProperty(
        name="Set the scene's rate and range", description="Otherwise keys are placed at the scene's own rate", default=True
    )
    start_frame: bpy.props.IntProperty(name="Start frame", description="Frame of the scene at which the take begins", default=1)
    feet: bpy.props.EnumProperty(name="Feet", items=FEET_ITEMS, default=DEFAULT_FEET)
    use_decisions: bpy.props.BoolProperty(
        name="Apply review decisions",
        description="Apply the decisions in TAKE.mocapfix beside the take, if it was cleaned and reviewed before",
        default=True,
    )
    keep_files: bpy.props.BoolProperty(
        name="Keep the cleaned files",
        description="Write all files of the take and of the character into TAKE.mocapfix beside the take, replacing earlier ones",
        default=False,
    )
    options: bpy.props.StringProperty(name="Options", description="More options of `mocapfix clean`, for example --up Z")

    def invoke(self, context, event) -> set[str]:
        """Retarget the take of the panel; without one, ask for a file."""
        return self.execute(context) if self.filepath else ImportHelper.invoke(self, context, event)

    def execute(self, context) -> set[str]:
        """Write the rest pose and start mocapfix."""
        temporary = make_temporary_folder()
        try:
            take = resolve_take(bpy.path.abspath(self.filepath) if self.filepath else "")
            armature = find_target(context, str(take))
            character = temporary / f"{get_character_name(armature)}.yaml"
            write_character(character, armature)
            arguments = build_arguments(
                take, self.options, frame_rate=self.frame_rate, feet=self.feet, use_decisions=self.use_decisions
            )
        except ProcessError as error:
            shutil.rmtree(temporary, ignore_errors=True)
            return self.fail(error)
        arguments += ["--character", str(character)]
        if self.mapping_file:
            arguments += ["--character-map", bpy.path.abspath(self.mapping_file)]
        if self.subject:
            arguments += ["--subject-prefix", self.subject]
        # The armature is looked up by its name at the end: Blender may have moved it in memory, after an undo for example.
        self._take, self._armature_name, self._suffix = take, armature.name, f".{character.stem}.npz"
        self._started = time.time() - 1.0  # times of files may be rounded to seconds
        return self.start(context, arguments, temporary, get_output_folder(take) if self.keep_files else None)

    def finish(self, context, process: CleaningProcess) -> None:
        """Key the bones."""
        armature = bpy.data.objects.get(self._armature_name)
        if armature is None or armature.type != "ARMATURE":
            raise ProcessError(f"The armature {self._armature_name} does not exist any more; select one and retarget again.")
        path = self._find_motion(process.output_folder)
        motion = read_bone_motion(path)
        check_bones(armature, motion)
        scale = get_object_scale(armature)
        if self.set_scene:
            set_rate_and_range(context.scene, motion.rate, self.start_frame, len(motion.basis))
        frames = compute_scene_frames(context.scene, len(motion.basis), motion.rate, self.start_frame)
        action_name = f"{path.name.removesuffix(self._suffix)} on {armature.name}"
        keys = ActionWriter(action_name, f"{self._take}\t{self.subject}\t{armature.name}").assign(armature)
        for n, name in enumerate(motion.names):
            location = motion.location / scale if name == motion.pelvis else None
            key_pose_bone(keys, armature.pose.bones[name], frames, motion.basis[:, n], location)
        key_rest_values(keys, armature, motion, frames[:1])
        armature[MAPPING_PROPERTY] = json.dumps(motion.segments)
        _store_mapping(armature, path.with_suffix(".map.yaml"))
        self._report_result(armature, motion)

    def _find_motion(self, folder: Path) -> Path:
        """Return the file with the motion of the armature."""
        paths = [each for each in sorted(folder.glob(f"*{self._suffix}")) if each.stat().st_mtime >= self._started]
        if not paths:
            raise ProcessError(
                f"{self._take.name}: has no skeleton, so there is no motion to retarget; see mocapfix's report of it."
            )
        if len(paths) > 1:
            names = ", ".join(read_subject(path.with_name(path.name.removesuffix(self._suffix) + ".npz")) for path in paths)
            raise ProcessError(f"{self._take.name}: has several subjects ({names}); choose one in the field Subject.")
        return paths[0]

    def _report_result(self, armature: bpy.types.Object, motion: BoneMotion) -> None:
        constrained = [
            name
            for name in motion.names
            if any(not each.mute and each.influence for each in armature.pose.bones[name].constraints)
        ]
        if constrained:
            names = ", ".join(constrained[:MAX_NAMED_BONES])
            more = f" and {len(constrained) - MAX_NAMED_BONES} more" if len(constrained) > MAX_NAMED_BONES else ""
            self.report(
                {"WARNING"}, f"{armature.name}: {names}{more} have constraints, which change the retargeted motion; mute them."
            )
        self.report(
            {"INFO"}, f"{armature.name}: {len(motion.names)} bones keyed in {len(motion.basis)} frames at {motion.rate:g} Hz."
        )


def find_target(context, take: str) -> bpy.types.Object:
    """Return the armature to retarget onto: the active one, else the only selected one, but not the one imported from the take.

    Raises:
        ProcessError: If there is no such armature, or if it cannot be edited.
    """
    selected = [each for each in context.selected_objects if each.type == "ARMATURE"]
    if context.object is not None and context.object.mode == "POSE" and context.object not in selected:
        selected.append(context.object)
    targets = [each for each in selected if str(each.get(TAKE_PROPERTY, "")).split("\t")[0] != take]
    active = [each for each in targets if each == context.object]
    chosen = active or targets
    if not chosen:
        raise ProcessError("No armature is selected; select the armature of the character onto which the take is retargeted.")
    if len(chosen) > 1:
        raise ProcessError("Several armatures are selected; make the one of the character the active object.")
    if chosen[0].library is not None:
        raise ProcessError(f"The armature {chosen[0].name} is linked from another file; make a library override of it.")
    if RIGIFY_PROPERTY in chosen[0].data and any(bone.name.startswith("ORG-") for bone in chosen[0].data.bones):
        raise ProcessError(
            f"{chosen[0].name} was generated by Rigify, so that its bones follow its controls; retarget onto its metarig instead."
        )
    return chosen[0]


def check_bones(armature: bpy.types.Object, motion: BoneMotion) -> None:
    """Raise ProcessError if bones do not move as mocapfix assumes: with their parents, the pelvis free to move."""
    missing = [name for name in motion.names if name not in armature.pose.bones]
    if missing:
        raise ProcessError(f"{armature.name}: has no bone {missing[0]} any more; retarget again.")
    for bone in _list_with_parents(armature, motion):
        if bone.parent is not None and not bone.bone.use_inherit_rotation:
            raise ProcessError(
                f"{armature.name}: bone {bone.name} does not inherit rotation; switch Inherit Rotation on (Bone > Relations)."
            )
    pelvis = armature.data.bones[motion.pelvis]
    if pelvis.use_connect:
        raise ProcessError(f"{armature.name}: bone {pelvis.name} is connected to its parent and cannot move; disconnect it.")
    if not pelvis.use_local_location:
        raise ProcessError(
            f"{armature.name}: bone {pelvis.name} moves in other axes; switch Local Location on (Bone > Relations)."
        )


def key_rest_values(keys: KeyWriter, armature: bpy.types.Object, motion: BoneMotion, frame: np.ndarray) -> None:
    """Key what an earlier pose has left in the moved bones and above them: scales, locations, rotations of bones above."""
    one = np.ones((1, 3))
    for bone in _list_with_parents(armature, motion):
        path = bone.path_from_id()
        if any(abs(each - 1.0) > 1e-6 for each in bone.scale):
            keys.write(f"{path}.scale", frame, one, group=bone.name)
        is_moved = bone.name in motion.names
        location = np.zeros((1, 3)) if bone.location.length > 1e-9 and bone.name != motion.pelvis else None
        if not is_moved:
            key_pose_bone(keys, bone, frame, np.array([[0.0, 0.0, 0.0, 1.0]]), location)
        elif location is not None:
            keys.write(f"{path}.location", frame, location, group=bone.name)


def _list_with_parents(armature: bpy.types.Object, motion: BoneMotion) -> list[bpy.types.PoseBone]:
    """Return the moved bones and all bones above them."""
    found: dict[str, bpy.types.PoseBone] = {}
    for name in motion.names:
        bone = armature.pose.bones[name]
        while bone is not None and bone.name not in found:
            found[bone.name] = bone
            bone = bone.parent
    return list(found.values())


def _store_mapping(armature: bpy.types.Object, path: Path) -> None:
    """Keep the mapping that mocapfix has written as a text of Blender, in which it can be edited."""
    if not path.exists():
        return
    name = get_mapping_text_name(armature)
    text = bpy.data.texts.get(name) or bpy.data.texts.new(name)
    text.clear()
    text.write(path.read_text(encoding="utf-8"))


def get_mapping_text_name(armature: bpy.types.Object) -> str:
    """Return the name of the text with the mapping of an armature."""
    return f"{armature.name}.map.yaml"


def get_mapping(armature: bpy.types.Object) -> dict[str, list[str]]:
    """Return the bones of each segment of the body that the last retargeting has used."""
    return json.loads(armature.get(MAPPING_PROPERTY, "{}"))
