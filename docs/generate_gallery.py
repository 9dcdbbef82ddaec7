"""Make the gallery, the first page of the documentation: `python docs/generate_gallery.py [NAME ...]`.

Needs Chromium (`make browser`), which draws the scenes with the three.js of the review page. Every take is composed, so each
result is compared with a known truth. The captions in docs/index.md, between `<!-- NAME -->` and `<!-- end -->`, are written
with the measured errors. Without names everything is made, which takes some minutes.
"""

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import yaml
from gallery_pages import make_review_page, make_review_views, make_session_page
from gallery_scene import (
    BALL_M,
    CHARACTER,
    CLIP_FRAMES_PER_S,
    DOCS,
    ESTIMATED,
    FAULTY,
    MEASURED,
    PICTURES,
    RELABELLED,
    UNLABELLED,
    Joints,
    Panel,
    Studio,
    View,
    compute_error_mm,
    name_joints,
    save_clip,
    save_picture,
)
from generate_tables import fill_section
from jaxtyping import Bool, Float
from PIL import Image
from playwright.sync_api import sync_playwright
from scipy.spatial.transform import Rotation

import mocapfix
from mocapfix.characters.body_frames import build_body_frame, compute_segment_motion
from mocapfix.characters.character import (
    Character,
    CharacterMotion,
    build_cmu31_character,
    compute_character_poses,
    convert_motion,
)
from mocapfix.characters.load_character import load_character
from mocapfix.characters.retarget_motion import build_solve_tree, compose_character_motion, retarget_motion, spread_rotations
from mocapfix.io.bvh import read_bvh, write_bvh
from mocapfix.io.c3d import write_c3d
from mocapfix.lab.label_recovery import remove_labels
from mocapfix.lab.review_page import CHROMIUM_ARGUMENTS, find_chromium
from mocapfix.model.skeleton import compute_local_rotations
from mocapfix.model.take import Take
from mocapfix.result import CleaningResult
from mocapfix.synthetic import SyntheticTake, compose_take, interpolate_markers

RATE_HZ = 100.0  # of the composed takes
CLIP_STEP = round(RATE_HZ / CLIP_FRAMES_PER_S)  # frames from one picture of a clip to the next
GAP, GAP_S = "RWRA", (4.75, 5.95)
SWAPPED, SWAP_S = ("LKNE", "RKNE"), (2.75, 3.35)
LOST_JOINTS, LOST_S = ("LeftArm", "LeftForeArm", "LeftHand"), (1.0, 2.5)


def select_frames(first_s: float, end_s: float, margin_s: float = 0.0) -> slice:
    """Return the frames of an interval with a margin on both sides."""
    return slice(round((first_s - margin_s) * RATE_HZ), round((end_s + margin_s) * RATE_HZ))


def clean_markers(markers: Float[np.ndarray, "T M 3"], labels: Sequence[str]) -> CleaningResult:
    """Write markers as a C3D file and clean it."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "walk.c3d"
        write_c3d(path, Take(markers, tuple(labels), RATE_HZ))
        return mocapfix.clean(path, marker_set="cmu41", feet="lock")


def get_solved_joints(result: CleaningResult, frame: int) -> Joints:
    """Return the joints of the solved body in a frame."""
    assert result.subject is not None
    assert result.joint_position_world is not None
    return name_joints(result.subject.skeleton.names, result.joint_position_world[frame])


@dataclass(frozen=True)
class DamagedTake:
    """A composed take with three faults, as cleaned: a gap, a swap of labels and a lost arm."""

    truth: SyntheticTake
    markers: Float[np.ndarray, "T M 3"]  # m, damaged
    is_arm: Bool[np.ndarray, " M"]  # whether a marker is one of the lost arm
    result: CleaningResult

    def add_bodies(self, before: Panel, after: Panel, frame: int, opacity: float = 1.0, marked: Sequence[str] = ()) -> Joints:
        """Add the true body and the solved body, and return the true joints."""
        joints = name_joints(self.truth.subject.skeleton.names, self.truth.joint_positions[frame])
        before.add_body(joints, opacity=opacity, marked=marked, mark="#f0b9b3")
        after.add_body(get_solved_joints(self.result, frame), opacity=opacity, marked=marked, mark="#a5dcb9")
        return joints

    def compute_errors_mm(self, frames: slice, markers: Sequence[int], others: Float[np.ndarray, "T M 3"]) -> tuple[float, float]:
        """Return the errors of other positions of some markers, and of the cleaned ones."""
        true_m = self.truth.marker_positions[frames][:, markers]
        other_mm, cleaned_mm = (compute_error_mm(each[frames][:, markers], true_m) for each in (others, self.result.take.markers))
        return other_mm, cleaned_mm


@cache
def clean_damaged_take() -> DamagedTake:
    """Compose, damage and clean the take of the first three pictures."""
    truth = compose_take(seed=2, seconds=8.0, rate=RATE_HZ)
    markers, skeleton = truth.marker_positions.copy(), truth.subject.skeleton
    is_arm = np.isin(truth.subject.joints, [skeleton.find_joint(name) for name in LOST_JOINTS])
    markers[select_frames(*LOST_S), is_arm] = np.nan
    markers[select_frames(*GAP_S), truth.labels.index(GAP)] = np.nan
    pair = [truth.labels.index(label) for label in SWAPPED]
    markers[select_frames(*SWAP_S), pair] = markers[select_frames(*SWAP_S), pair[::-1]]
    return DamagedTake(truth, markers, is_arm, clean_markers(markers, truth.labels))


def make_gap(studio: Studio) -> str:
    """Draw the path of a marker that is lost during a reach, and return the caption."""
    take, frames, shown = clean_damaged_take(), select_frames(*GAP_S), select_frames(*GAP_S, 0.4)
    m, middle = take.truth.labels.index(GAP), (frames.start + frames.stop) // 2
    true_m, cleaned_m = take.truth.marker_positions[:, m], take.result.take.markers[:, m]
    cubic_mm, error_mm = take.compute_errors_mm(frames, [m], interpolate_markers(take.markers, 3))
    before = Panel("Before", f"lost for {GAP_S[1] - GAP_S[0]:.1f} s", ("measured", "lost"))
    after = Panel("After", f"error {error_mm:.0f} mm", ("measured", "estimated"))
    centre = take.add_bodies(before, after, middle)["Spine1"] + [-0.08, 0.18, 0.1]
    for panel, colour in ((before, FAULTY), (after, ESTIMATED)):
        panel.add_balls(np.delete(take.result.take.markers[middle], m, axis=0), MEASURED, 0.012)
        panel.add_trail(take.markers[shown, m], MEASURED)
        panel.add_label(GAP, true_m[middle], colour, (0, -24))
    before.add_rings(true_m[[middle]], FAULTY, 0.032)
    before.add_trail(true_m[[frames.start - 1, frames.stop]], FAULTY, dashed=True, radius=0.005)
    after.add_trail(cleaned_m[frames.start - 1 : frames.stop + 1], ESTIMATED, radius=0.009)
    after.add_balls(cleaned_m[[middle]], ESTIMATED, 0.024)
    save_picture("gap", studio.draw((before, after), 2 * [View(centre, 3.2, -35.0, 6.0)]))
    method = next(change.method for change in take.result.changes if change.markers == (GAP,))
    return (
        f"A marker of the wrist is lost for {GAP_S[1] - GAP_S[0]:.1f} s while the hand reaches up. Its samples are {method}. "
        f"Their error is {error_mm:.0f} mm; that of a cubic spline is {cubic_mm:.0f} mm."
    )


def make_swap(studio: Studio) -> str:
    """Draw the paths of two markers whose labels are exchanged for a while, and return the caption."""
    take, frames, shown = clean_damaged_take(), select_frames(*SWAP_S), select_frames(*SWAP_S, 0.3)
    pair, middle = [take.truth.labels.index(label) for label in SWAPPED], (frames.start + frames.stop) // 2
    damaged_mm, error_mm = take.compute_errors_mm(frames, pair, take.markers)
    before = Panel("Before", f"error {damaged_mm:.0f} mm", ("measured", "faulty"))
    after = Panel("After", f"error {error_mm:.0f} mm", ("measured", "labelled"))
    hips = take.add_bodies(before, after, middle, opacity=0.45)["Hips"]
    for panel, markers, colour in ((before, take.markers, FAULTY), (after, take.result.take.markers, RELABELLED)):
        panel.add_balls(np.delete(markers[middle], pair, axis=0), MEASURED, 0.012)
        for label, m in zip(SWAPPED, pair, strict=True):
            panel.add_trail(markers[shown.start : frames.start, m], MEASURED)
            panel.add_trail(markers[frames, m], colour, radius=0.009)
            panel.add_trail(markers[frames.stop : shown.stop, m], MEASURED)
            for first in (frames.start - 1, frames.stop - 1):
                panel.add_trail(markers[first : first + 2, m], colour)
            panel.add_balls(markers[[middle], m], colour, 0.026)
            panel.add_label(label, markers[middle, m], colour, (34 if markers[middle, m, 0] > hips[0] else -36, 0))
    save_picture("swap", studio.draw((before, after), 2 * [View(hips + [0.0, -0.12, 0.0], 4.0, 14.0, 24.0)]))
    return (
        f"The labels of both knees are exchanged for {SWAP_S[1] - SWAP_S[0]:.1f} s of a walk, so each path jumps to the other "
        f"leg. mocapfix exchanges them back: the error falls from {damaged_mm:.0f} mm to {error_mm:.0f} mm, and nothing is "
        "interpolated."
    )


def make_lost_limb(studio: Studio) -> str:
    """Draw a clip of an arm whose markers are all lost, and return the caption."""
    take, frames, shown = clean_damaged_take(), select_frames(*LOST_S), select_frames(*LOST_S, 0.6)
    arm, true_m = np.flatnonzero(take.is_arm), take.truth.marker_positions
    linear_mm, error_mm = take.compute_errors_mm(frames, arm.tolist(), interpolate_markers(take.markers, 1))
    pictures: list[Image.Image] = []
    for frame in range(shown.start, shown.stop, CLIP_STEP):
        is_lost = frames.start <= frame < frames.stop
        before = Panel("Before", f"{len(arm)} markers lost" if is_lost else "", ("measured", "lost"))
        after = Panel("After", f"error {error_mm:.0f} mm" if is_lost else "", ("measured", "estimated"))
        joints = take.add_bodies(before, after, frame, marked=LOST_JOINTS if is_lost else ())
        for panel, markers in ((before, take.markers[frame]), (after, take.result.take.markers[frame])):
            panel.add_balls(markers[~take.is_arm], MEASURED)
            panel.add_balls(markers[arm], ESTIMATED if is_lost else MEASURED, BALL_M * (1.3 if is_lost else 1.0))
        before.add_rings(true_m[frame, arm if is_lost else []], FAULTY)
        view = View(joints["Hips"] * [0, 0, 1] + [0.0, 0.86, 0.0], 4.3, 48.0)
        pictures.append(studio.draw((before, after), [view, view], pixel_ratio=1))
    save_clip("lost-limb", pictures)
    return (
        f"All markers of an arm are lost for {LOST_S[1] - LOST_S[0]:.1f} s. mocapfix estimates them from how the arm moved with "
        f"the body elsewhere in the take, with an error of {error_mm:.0f} mm; that of straight lines is {linear_mm:.0f} mm."
    )


UNLABELLED_START_S, UNLABELLED_END_S = 2.6, 9.0  # of the composed take: after its lost arm
NAMED_MARKERS = ("LFHD", "RSHO", "CLAV", "LELB", "RWRA", "LWRB", "STRN", "LKNE", "RSHN", "LANK", "RMT5")
SAME_POINT_M = 0.002  # distance below which a cleaned sample is the point that was measured
UPRIGHT_M = 0.85  # height of the hips


def make_unlabelled(studio: Studio) -> str:
    """Draw a take without labels and what was labelled, and return the caption."""
    truth = compose_take(seed=5, seconds=UNLABELLED_END_S, rate=RATE_HZ)
    frames = select_frames(UNLABELLED_START_S, UNLABELLED_END_S)
    true_m, is_missing = truth.marker_positions[frames], truth.missing_mask[frames]
    unlabelled = remove_labels("ghosts", np.where(is_missing[..., None], np.nan, true_m), RATE_HZ, seed=1)
    points, sources = unlabelled.points, unlabelled.marker_indices
    result = clean_markers(points, [f"*{n + 1}" for n in range(points.shape[1])])
    cleaned_m = result.take.markers[:, [result.take.labels.index(label) for label in truth.labels]]
    is_measured = np.stack([(sources == m).any(axis=1) for m in range(len(truth.labels))], axis=1)
    is_right = np.linalg.norm(cleaned_m - true_m, axis=-1) < SAME_POINT_M
    right_percent = 100 * is_right[is_measured].mean()
    is_ghost = (sources < 0) & np.isfinite(points[..., 0])
    is_upright = np.array([get_solved_joints(result, t)["Hips"][1] > UPRIGHT_M for t in range(len(points))])
    frame = int(np.argmax(np.where(is_ghost.any(axis=1) & is_upright, (~is_measured).sum(axis=1), 0)))
    before = Panel("Before", f"{points.shape[1]} trajectories", ("without a label", "ghost"))
    after = Panel("After", f"{right_percent:.3g} % right", ("labelled", "estimated"))
    before.add_balls(points[frame, ~is_ghost[frame]], UNLABELLED, 0.019)
    before.add_balls(points[frame, is_ghost[frame]], FAULTY, 0.019)
    joints, is_labelled = get_solved_joints(result, frame), is_right[frame] & is_measured[frame]
    after.add_body(joints)
    after.add_balls(cleaned_m[frame, is_labelled], RELABELLED, 0.019)
    after.add_balls(cleaned_m[frame, ~is_labelled], ESTIMATED, 0.019)
    for label in NAMED_MARKERS:
        m, shift = truth.labels.index(label), (26 if label.startswith(("L", "C")) else -28, 0)
        for column in np.flatnonzero(sources[frame] == m):
            before.add_label(f"*{column + 1}", points[frame, column], "#8a5a10", shift)
        after.add_label(label, cleaned_m[frame, m], RELABELLED if is_labelled[m] else ESTIMATED, shift)
    view = View(joints["Hips"] * [1, 0, 1] + [-0.05, 0.98, 0.0], 4.7, 20.0)
    save_picture("unlabelled", studio.draw((before, after), [view, view]))
    return (
        f"{len(truth.labels)} markers without labels: {points.shape[1]} trajectories in random order, ghosts among them. "
        f"mocapfix finds the person, gives {right_percent:.3g} % of the points the right label and fills the gaps between them; "
        f"the error of all markers is {compute_error_mm(cleaned_m, true_m):.1f} mm."
    )


FLIP_S, FLIPPED_JOINTS, FLIP_DEG = (4.75, 5.35), ("RightArm", "RightForeArm", "RightHand"), 150.0


def write_flipped_animation(path: Path) -> SyntheticTake:
    """Write an animation in which an arm flips, and return the take without that fault."""
    truth, frames = compose_take(seed=7, seconds=7.0, rate=RATE_HZ), select_frames(*FLIP_S)
    skeleton, rotations = truth.subject.skeleton, truth.motion.local_rotations.copy()
    upper_arm = skeleton.find_joint(FLIPPED_JOINTS[0])
    flip = Rotation.from_euler("X", FLIP_DEG, degrees=True).as_matrix()
    rotations[frames, upper_arm] = flip @ rotations[frames, upper_arm]
    write_bvh(path, skeleton, replace(truth.motion, local_rotations=rotations), RATE_HZ)
    return truth


def make_animation(studio: Studio) -> str:
    """Draw an animation in which an arm flips, and return the caption."""
    frames = select_frames(*FLIP_S)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "reach.bvh"
        truth = write_flipped_animation(path)
        cleaned = mocapfix.clean(path).write(Path(folder) / "cleaned")["bvh"]
        positions = [read_bvh(each).compute_world_poses()[0] for each in (path, cleaned)]
    skeleton = truth.subject.skeleton
    arm = [skeleton.find_joint(joint) for joint in FLIPPED_JOINTS[1:]]
    true_m, shown = truth.joint_positions, frames.stop - round(0.17 * RATE_HZ)
    errors_mm = [compute_error_mm(each[frames][:, arm], true_m[frames][:, arm]) for each in positions]
    before = Panel("Before", f"error {errors_mm[0]:.0f} mm", ("faulty",))
    after = Panel("After", f"error {errors_mm[1]:.0f} mm", ("repaired",))
    for panel, position, colour in zip((before, after), positions, (FAULTY, ESTIMATED), strict=True):
        panel.add_body(name_joints(skeleton.names, position[shown]), marked=FLIPPED_JOINTS, mark=colour)
        panel.add_trail(position[frames.start - 1 : frames.stop + 1, arm[-1]], colour)
    view = View(true_m[shown, 0] * [1, 0, 1] + [-0.1, 0.95, 0.0], 4.2, -72.0)
    save_picture("animation", studio.draw((before, after), [view, view]))
    return (
        f"In a BVH file an arm is turned by {FLIP_DEG:.0f} degrees for {FLIP_S[1] - FLIP_S[0]:.1f} s. mocapfix removes the turn "
        f"and keeps the motion within it: the error of elbow and hand falls from {errors_mm[0]:.0f} mm to {errors_mm[1]:.0f} mm."
    )


def make_views(studio: Studio) -> str:
    """Take a picture of six views of the review page, one of an animation among them, and return the caption."""
    return make_review_views(studio, write_flipped_animation)


LEG_SCALE = 0.62
CHARACTER_S = (0.6, 4.0)


def write_short_legged_figure(path: Path) -> None:
    """Write the shipped Mixamo figure with shorter legs as a character file."""
    figure = yaml.safe_load((DOCS.parent / "scenes/rigs/mixamo.yaml").read_text(encoding="utf-8"))
    lowered_m = (1 - LEG_SCALE) * next(bone["head"][1] for bone in figure["bones"] if bone["name"].endswith("LeftUpLeg"))
    for bone in figure["bones"]:
        is_leg = any(part in bone["name"] for part in ("Leg", "Foot", "Toe"))
        for end in {"head", "tail"} & bone.keys():
            bone[end][1] = LEG_SCALE * bone[end][1] if is_leg else bone[end][1] - lowered_m
    path.write_text(yaml.safe_dump(figure), encoding="utf-8")


def measure_slide_mm(toes: dict[str, Float[np.ndarray, "T 3"]], contacts: Sequence[tuple[str, int, int]]) -> float:
    """Return how far a foot gets from where it first stood, on the floor: the mean over contacts (side, first, last frame)."""
    ways = [toes[side][first : last + 1, [0, 2]] - toes[side][first, [0, 2]] for side, first, last in contacts]
    return float(np.mean([np.linalg.norm(way, axis=1).max() for way in ways]) * 1e3)


def copy_rotations(source: Character, motion: CharacterMotion, target: Character) -> CharacterMotion:
    """Return the motion of a target as constraints in Blender make it: rotations in the world, and the path of the pelvis."""
    source_frame, target_frame = build_body_frame(source), build_body_frame(target)
    segments, tree = compute_segment_motion(source_frame, motion), build_solve_tree(target_frame)
    rotation = spread_rotations(source_frame, target_frame, tree, segments)
    standing = [frame.leg_length_m + frame.ankle_height_m - frame.hip_centre[1] for frame in (source_frame, target_frame)]
    pelvis = segments.position["pelvis"] + np.array([0.0, standing[1] - standing[0], 0.0])
    return compose_character_motion(
        target_frame, tree, pelvis, compute_local_rotations(rotation, tree.skeleton.parents), motion.rate
    )


def make_character(studio: Studio) -> str:
    """Draw a clip of a character with short legs, with copied rotations and retargeted, and return the caption."""
    truth = compose_take(seed=2, seconds=5.0, rate=RATE_HZ)
    result = clean_markers(truth.marker_positions, truth.labels)
    assert result.subject is not None
    assert result.motion is not None
    assert result.contacts is not None
    with TemporaryDirectory() as folder:
        write_short_legged_figure(Path(folder) / "figure.yaml")
        figure = load_character(Path(folder) / "figure.yaml")
    source, performed = build_cmu31_character(result.subject.skeleton), convert_motion(result.motion, RATE_HZ)
    motions = (copy_rotations(source, performed, figure), retarget_motion(source, performed, figure, contacts=result.contacts))
    positions = [compute_character_poses(figure, motion)[0] for motion in motions]
    names = [bone.removeprefix("mixamorig:") for bone in figure.skeleton.names]
    feet = {side: (f"{side}Foot", f"{side}ToeBase") for side in ("Left", "Right")}
    contacts = [(side, *interval) for side, (_, toe) in feet.items() for interval in result.contacts.list_intervals(toe)]
    toes = [{side: position[:, names.index(toe)] for side, (_, toe) in feet.items()} for position in positions]
    copied_mm, slide_mm = (measure_slide_mm(each, contacts) for each in toes)
    pictures: list[Image.Image] = []
    shown = select_frames(*CHARACTER_S)
    for frame in range(shown.start, shown.stop, CLIP_STEP):
        before = Panel("Before: rotations copied", f"{copied_mm:.0f} mm", ("standing foot that slides",))
        after = Panel("After", f"{slide_mm:.0f} mm", ("standing foot",))
        views: list[View] = []
        for panel, position, colour in zip((before, after), positions, (FAULTY, ESTIMATED), strict=True):
            standing = {side: first for side, first, last in contacts if first <= frame <= last}
            marked = [joint for side in standing for joint in feet[side]]
            panel.add_body(name_joints(names, position[frame]), CHARACTER, marked=marked, mark=colour)
            for side, first in standing.items():  # where the foot first stood
                panel.add_parts(name_joints(names, position[first]), feet[side], colour, 0.35)
            views.append(View(position[frame, names.index("Hips")] * [0, 0, 1] + [0.0, 0.6, 0.0], 3.7, 62.0, 14.0))
        pictures.append(studio.draw((before, after), views, pixel_ratio=1))
    save_clip("character", pictures)
    return (
        f"The walk is put on a character whose legs have {100 * LEG_SCALE:.0f} % of their length. With copied rotations a "
        f"standing foot slides by {copied_mm:.0f} mm; mocapfix scales the places of the feet and solves for them, and it "
        f"slides by {slide_mm:.0f} mm."
    )


EXHIBITS: dict[str, Callable[[Studio], str]] = {
    "gap": make_gap,
    "swap": make_swap,
    "lost-limb": make_lost_limb,
    "unlabelled": make_unlabelled,
    "animation": make_animation,
    "character": make_character,
    "review-page": make_review_page,
    "review-views": make_views,
    "session-page": make_session_page,
}
"""Functions that make the pictures of a section of the page, and return its caption."""


def main() -> None:
    PICTURES.mkdir(exist_ok=True)
    page = DOCS / "index.md"
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=find_chromium(), args=list(CHROMIUM_ARGUMENTS))
        studio = Studio(browser)
        for name in sys.argv[1:] or EXHIBITS:
            caption = EXHIBITS[name](studio)
            page.write_text(fill_section(page.read_text(encoding="utf-8"), name, lambda text=caption: text), encoding="utf-8")
        browser.close()


if __name__ == "__main__":
    main()
