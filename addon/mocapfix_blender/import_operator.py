"""File > Import > C3D/TRC, cleaned: clean a take and bring in its armature, its markers and where it is uncertain."""

import time

import bpy
from bpy_extras.io_utils import ImportHelper

from .armature import build_armature, find_armature, key_body
from .bvh_file import read_bvh_body
from .clean_arguments import DEFAULT_FEET, FEET_ITEMS, build_arguments, get_output_folder, resolve_take
from .keyframes import ActionWriter
from .marker_empties import build_markers
from .process import CleaningProcess, ProcessError, make_temporary_folder
from .process_operator import ProcessOperator
from .solved_take import SolvedTake, read_solved_takes
from .timeline import compute_scene_frames, mark_uncertain_stretches, set_rate_and_range
from .uncertain_stretches import find_uncertain_stretches

DEFAULT_MAX_SD_MM = 60.0
"""fills with a larger predicted standard deviation are marked, as in mocapfix's report"""


class MOCAPFIX_OT_import_take(ProcessOperator, bpy.types.Operator, ImportHelper):
    """Clean a motion capture take with mocapfix and import its skeleton and markers"""

    bl_idname = "mocapfix.import_take"
    bl_label = "Import cleaned take"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    filter_glob: bpy.props.StringProperty(default="*.c3d;*.trc;*.csv;*.bvh", options={"HIDDEN"})
    frame_rate: bpy.props.FloatProperty(
        name="Frame rate", description="Frames per second of the motion; 0: those of the take", default=0.0, min=0.0, max=1000.0
    )
    set_scene: bpy.props.BoolProperty(
        name="Set the scene's rate and range", description="Otherwise keys are placed at the scene's own rate", default=True
    )
    start_frame: bpy.props.IntProperty(name="Start frame", description="Frame of the scene at which the take begins", default=1)
    import_markers: bpy.props.BoolProperty(name="Markers", description="Import markers as animated empties", default=True)
    mark_uncertain: bpy.props.BoolProperty(
        name="Mark uncertain stretches", description="Put markers on the timeline where the take is uncertain", default=True
    )
    max_sd_mm: bpy.props.FloatProperty(
        name="Uncertain above (mm)",
        description="Mark fills whose predicted standard deviation is larger than this",
        default=DEFAULT_MAX_SD_MM,
        min=0.0,
    )
    feet: bpy.props.EnumProperty(name="Feet", items=FEET_ITEMS, default=DEFAULT_FEET)
    keep_files: bpy.props.BoolProperty(
        name="Keep the cleaned files",
        description="Write the cleaned file and its report into TAKE.mocapfix beside the take, replacing earlier ones",
        default=False,
    )
    use_decisions: bpy.props.BoolProperty(
        name="Apply review decisions",
        description="Apply the decisions in TAKE.mocapfix beside the take, if it was cleaned and reviewed before",
        default=True,
    )
    options: bpy.props.StringProperty(name="Options", description="More options of `mocapfix clean`, for example --up Z")

    def execute(self, context) -> set[str]:
        """Start mocapfix."""
        try:
            take = resolve_take(bpy.path.abspath(self.filepath) if self.filepath else "")
            arguments = build_arguments(
                take, self.options, frame_rate=self.frame_rate, feet=self.feet, use_decisions=self.use_decisions
            )
        except ProcessError as error:
            return self.fail(error)
        self._take, self._started = take, time.time() - 1.0  # times of files may be rounded to seconds
        return self.start(context, arguments, make_temporary_folder(), get_output_folder(take) if self.keep_files else None)

    def finish(self, context, process: CleaningProcess) -> None:
        """Build what mocapfix has written."""
        takes = [self._use_own_skeleton(each, process) for each in read_solved_takes(process.output_folder, self._started)]
        if self.set_scene:
            length = max(each.frame_count for each in takes)
            set_rate_and_range(context.scene, takes[0].rate, self.start_frame, length)
        stretch_count = sum(self._build_take(context, each) for each in takes)
        self._report_result(takes, stretch_count)

    def _use_own_skeleton(self, take: SolvedTake, process: CleaningProcess) -> SolvedTake:
        """Return a take with the skeleton of the file, if it is a BVH."""
        path = process.output_folder / f"{self._take.stem}.bvh"
        if take.is_animation and self._take.suffix.lower() == ".bvh" and not self.frame_rate:
            return take.replace_body(read_bvh_body(path, take))
        return take

    def _build_take(self, context, take: SolvedTake) -> int:
        """Build one subject of a take; return the number of uncertain stretches that were marked."""
        take_key, scene = f"{self._take}\t{take.subject}", context.scene
        armature = find_armature(take_key)
        if take.body is not None:
            armature = build_armature(context, take.body, take.name, take_key)
            frames = compute_scene_frames(scene, take.frame_count, take.rate, self.start_frame)
            key_body(armature, take.body, frames, ActionWriter(take.name, take_key))
        if self.import_markers and not take.is_animation:
            frames = compute_scene_frames(scene, len(take.markers), take.marker_rate, self.start_frame)
            build_markers(context, take, take_key, armature, frames, ActionWriter(f"{take.name} markers", take_key))
        stretches = find_uncertain_stretches(take, self.max_sd_mm * 1e-3) if self.mark_uncertain else []
        mark_uncertain_stretches(scene, take_key, stretches, self.start_frame)
        if armature is not None and armature.visible_get():
            for each in list(context.view_layer.objects.selected):
                each.select_set(False)
            armature.select_set(True)
            context.view_layer.objects.active = armature
        return len(stretches)

    def _report_result(self, takes: list[SolvedTake], stretch_count: int) -> None:
        for each in takes:
            if each.body is None:
                notes = " ".join(each.report["notes"][:1])
                self.report({"WARNING"}, f"{each.name}: has no skeleton, so only its markers are imported. {notes}")
        names = ", ".join(each.name for each in takes)
        self.report(
            {"INFO"},
            f"{names}: {takes[0].frame_count} frames at {takes[0].rate:g} Hz, {stretch_count} uncertain stretches marked.",
        )


class MOCAPFIX_FH_take(bpy.types.FileHandler):
    """Takes that are dropped into the 3-D view"""

    bl_idname = "MOCAPFIX_FH_take"
    bl_label = "Motion capture take"
    bl_import_operator = "mocapfix.import_take"
    bl_file_extensions = ".c3d;.trc"

    @classmethod
    def poll_drop(cls, context) -> bool:
        """Accept takes in the 3-D view."""
        return context.area is not None and context.area.type == "VIEW_3D"


def draw_import_menu(menu, _context) -> None:
    """Add the operator to File > Import."""
    menu.layout.operator(MOCAPFIX_OT_import_take.bl_idname, text="C3D/TRC, cleaned (mocapfix)")
