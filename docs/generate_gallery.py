"""Make the gallery, the first page of the documentation: `python docs/generate_gallery.py [NAME ...]`.

Needs Chromium (`make browser`), which draws the scenes with the three.js of the review page. Every take is composed, so each
result is compared with a known truth. The captions in docs/index.md, between `<!-- NAME -->` and `<!-- end -->`, are written
with the measured errors. Without names everything is made, which takes a few minutes.
"""

import io
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import chdir, contextmanager
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import yaml
from gallery_scene import *
from generate_tables import fill_section
from jaxtyping import Bool, Float
from PIL import Image
from playwright.sync_api import Page, ViewportSize, sync_playwright
from scipy.spatial.transform import Rotation

import mocapfix
from mocapfix.characters.character import build_cmu31_character, compute_character_poses, convert_motion
from mocapfix.characters.load_character import load_character
from mocapfix.characters.retarget_motion import retarget_motion
from mocapfix.cli.app import run_demo
from mocapfix.io.bvh import read_bvh, write_bvh
from mocapfix.io.c3d import write_c3d
from mocapfix.lab.label_recovery import remove_labels
from mocapfix.lab.retargeting import copy_rotations
from mocapfix.lab.review_page import CHROMIUM_ARGUMENTS, find_chromium
from mocapfix.model.take import Take
from mocapfix.result import CleaningResult
from mocapfix.review.review_session import ReviewSession
from mocapfix.review.server import ReviewServer
from mocapfix.synthetic import SyntheticTake, compose_take, interpolate_markers, write_synthetic_take

RATE_HZ = 100.0  # of the composed takes
SAME_POINT_M = 0.002  # distance below which a cleaned sample is the point that was measured


def compute_error_mm(first: Float[np.ndarray, "*n 3"], second: Float[np.ndarray, "*n 3"]) -> float:
    """Return the root mean square distance in millimetres."""
    return float(np.sqrt(np.nanmean(np.sum((first - second) ** 2, axis=-1))) * 1e3)


@dataclass(frozen=True)
class DamagedTake:
    """A composed take with three faults, as cleaned: a gap, a swap of labels and a lost arm."""

    truth: SyntheticTake
    markers: Float[np.ndarray, "T M 3"]
    is_arm: Bool[np.ndarray, " M"]
    result: CleaningResult

    def find(self, label: str) -> int:
        """Return the index of a marker."""
        return self.truth.labels.index(label)

    def get_true_joints(self, frame: int) -> Joints:
        """Return the joints of the composed body."""
        return name_joints(self.truth.subject.skeleton.names, self.truth.joint_positions[frame])

    def get_solved_joints(self, frame: int) -> Joints:
        """Return the joints of the solved body."""
        assert self.result.subject is not None
        assert self.result.joint_position_world is not None
        joints = self.result.joint_position_world[frame]
        return name_joints(self.result.subject.skeleton.names, np.where(np.isfinite(joints), joints, self.truth.joint_positions[frame]))


GAP, GAP_S = "RWRA", (4.75, 5.95)
SWAPPED, SWAP_S = ("LKNE", "RKNE"), (2.75, 3.35)
ARM_S = (1.0, 2.5)


def select_frames(interval_s: tuple[float, float]) -> slice:
    """Return the frames of an interval in seconds."""
    return slice(round(interval_s[0] * RATE_HZ), round(interval_s[1] * RATE_HZ))


@cache
def clean_damaged_take() -> DamagedTake:
    """Compose, damage and clean the take of the first three pictures."""
    truth = compose_take(seed=2, seconds=8.0, rate=RATE_HZ)
    markers = truth.marker_positions.copy()
    skeleton = truth.subject.skeleton
    is_arm = np.isin(truth.subject.joints, [skeleton.find_joint(name) for name in LEFT_ARM])
    markers[select_frames(ARM_S), is_arm] = np.nan
    markers[select_frames(GAP_S), truth.labels.index(GAP)] = np.nan
    pair = [truth.labels.index(label) for label in SWAPPED]
    markers[select_frames(SWAP_S), pair] = markers[select_frames(SWAP_S), pair[::-1]]
    with TemporaryDirectory() as folder:
        path = Path(folder) / "walk.c3d"
        write_c3d(path, Take(markers, truth.labels, RATE_HZ))
        return DamagedTake(truth, markers, is_arm, mocapfix.clean(path, feet="lock"))


def make_gap(studio: Studio) -> str:
    """Draw the path of a marker that is lost during a reach, and return the caption."""
    take = clean_damaged_take()
    m, frames, shown = take.find(GAP), select_frames(GAP_S), select_frames((GAP_S[0] - 0.35, GAP_S[1] + 0.45))
    middle = (frames.start + frames.stop) // 2
    truth, cleaned, input_ = take.truth.marker_positions[:, m], take.result.take.markers, take.markers
    cubic_mm = compute_error_mm(interpolate_markers(input_[:, [m]], 3)[frames, 0], truth[frames])
    error_mm = compute_error_mm(cleaned[frames, m], truth[frames])
    before = Panel("Before", "1.2 s lost", ("measured", "lost"))
    after = Panel("After", f"error {error_mm:.0f} mm", ("measured", "estimated"))
    for panel, markers in ((before, input_), (after, cleaned)):
        panel.add_body(take.get_true_joints(middle) if panel is before else take.get_solved_joints(middle))
        others = np.delete(markers[middle], m, axis=0)
        panel.add_balls(others, MEASURED, 0.012)
        panel.add_trail(input_[shown, m], MEASURED)
    before.add_rings(truth[[middle]], FAULTY, 0.032)
    before.add_trail(truth[[frames.start - 1, frames.stop]], FAULTY, dashed=True, radius=0.005)
    after.add_trail(cleaned[frames.start - 1 : frames.stop + 1, m], ESTIMATED, radius=0.009)
    after.add_balls(cleaned[[middle], m], ESTIMATED, 0.024)
    for panel in (before, after):
        panel.add_label(GAP, truth[middle], FAULTY if panel is before else ESTIMATED, (0, -24))
    centre = take.get_true_joints(middle)["Spine1"] + [-0.08, 0.18, 0.1]
    save_picture("gap", studio.draw((before, after), 2 * [View(centre, 3.2, -35.0, 6.0)]))
    return (
        f"A marker of the right wrist is lost for {GAP_S[1] - GAP_S[0]:.1f} s while the hand reaches up. mocapfix fills the gap from "
        f"the markers that move with it: {error_mm:.0f} mm from the truth (root mean square); a cubic spline is off by {cubic_mm:.0f} mm."
    )


def make_swap(studio: Studio) -> str:
    """Draw the paths of two markers whose labels are exchanged for a while, and return the caption."""
    take = clean_damaged_take()
    pair, frames, shown = [take.find(label) for label in SWAPPED], select_frames(SWAP_S), select_frames((SWAP_S[0] - 0.3, SWAP_S[1] + 0.3))
    middle = (frames.start + frames.stop) // 2
    truth, cleaned, input_ = take.truth.marker_positions, take.result.take.markers, take.markers
    errors_mm = [compute_error_mm(each[frames][:, pair], truth[frames][:, pair]) for each in (input_, cleaned)]
    before = Panel("Before", f"error {errors_mm[0]:.0f} mm", ("measured", "faulty"))
    after = Panel("After", f"error {errors_mm[1]:.0f} mm", ("measured", "relabelled"))
    for panel, markers, colour in ((before, input_, FAULTY), (after, cleaned, RELABELLED)):
        panel.add_body(take.get_true_joints(middle) if panel is before else take.get_solved_joints(middle), opacity=0.45)
        panel.add_balls(np.delete(markers[middle], pair, axis=0), MEASURED, 0.012)
        for label, m in zip(SWAPPED, pair, strict=True):
            panel.add_trail(markers[shown.start : frames.start, m], MEASURED)
            panel.add_trail(markers[frames.start - 1 : frames.start + 1, m], colour)
            panel.add_trail(markers[frames, m], colour, radius=0.009)
            panel.add_trail(markers[frames.stop - 1 : frames.stop + 1, m], colour)
            panel.add_trail(markers[frames.stop : shown.stop, m], MEASURED)
            panel.add_balls(markers[[middle], m], colour, 0.026)
            is_on_left = markers[middle, m, 0] > take.get_true_joints(middle)["Hips"][0]
            panel.add_label(label, markers[middle, m], colour, (34 if is_on_left else -36, 0))
    centre = take.get_true_joints(middle)["Hips"] + [0.0, -0.12, 0.0]
    save_picture("swap", studio.draw((before, after), 2 * [View(centre, 4.0, 14.0, 24.0)]))
    return (
        f"The labels of both knees are exchanged for {SWAP_S[1] - SWAP_S[0]:.1f} s of a walk, so each path jumps to the other leg. "
        f"mocapfix exchanges them back: the error falls from {errors_mm[0]:.0f} mm to {errors_mm[1]:.0f} mm, and nothing is interpolated."
    )


def make_lost_limb(studio: Studio) -> str:
    """Draw a clip of an arm whose markers are all lost, and return the caption."""
    take = clean_damaged_take()
    frames, arm = select_frames(ARM_S), take.is_arm
    truth, cleaned = take.truth.marker_positions, take.result.take.markers
    error_mm = compute_error_mm(cleaned[frames][:, arm], truth[frames][:, arm])
    linear_mm = compute_error_mm(interpolate_markers(take.markers, 1)[frames][:, arm], truth[frames][:, arm])
    pictures: list[Image.Image] = []
    shown = select_frames((ARM_S[0] - 0.6, ARM_S[1] + 0.6))
    for frame in range(shown.start, shown.stop, round(RATE_HZ / CLIP_FRAMES_PER_S)):
        is_lost = frames.start <= frame < frames.stop
        before = Panel("Before", "6 markers lost" if is_lost else "", ("measured", "lost"))
        after = Panel("After", f"error {error_mm:.0f} mm" if is_lost else "", ("measured", "estimated"))
        joints = take.get_true_joints(frame)
        marked = LEFT_ARM if is_lost else ()
        before.add_body({name: each for name, each in joints.items()}, marked=marked, mark="#f0b9b3")
        after.add_body(take.get_solved_joints(frame), marked=marked, mark="#a5dcb9")
        for panel, markers in ((before, take.markers), (after, cleaned)):
            panel.add_balls(markers[frame, ~arm], MEASURED)
            panel.add_balls(markers[frame, arm], MEASURED if not is_lost else ESTIMATED, BALL_M * (1.3 if is_lost else 1))
        if is_lost:
            before.add_rings(truth[frame, arm], FAULTY)
        centre = joints["Hips"] * [0, 0, 1] + [0.0, 0.86, 0.0]
        pictures.append(studio.draw((before, after), 2 * [View(centre, 4.3, 48.0)], pixel_ratio=1))
    save_clip("lost-limb", pictures)
    return (
        f"All six markers of an arm are lost for {ARM_S[1] - ARM_S[0]:.1f} s. mocapfix estimates them from how the arm moved with the rest "
        f"of the body elsewhere in the take: {error_mm:.0f} mm from the truth; straight lines are off by {linear_mm:.0f} mm."
    )


UNLABELLED_NAMED = ("LFHD", "RSHO", "CLAV", "LELB", "RWRA", "LWRB", "STRN", "LKNE", "RSHN", "LANK", "RMT5")


def make_unlabelled(studio: Studio) -> str:
    """Draw a take without labels and what was labelled, and return the caption."""
    truth = compose_take(seed=5, seconds=9.0, rate=RATE_HZ)
    after_lost_arm = slice(round(2.6 * RATE_HZ), None)
    true_m, is_missing = truth.marker_positions[after_lost_arm], truth.missing_mask[after_lost_arm, :, None]
    unlabelled = remove_labels("ghosts", np.where(is_missing, np.nan, true_m), RATE_HZ, seed=1)
    points, sources = unlabelled.points, unlabelled.marker_indices
    with TemporaryDirectory() as folder:
        path = Path(folder) / "unlabelled.c3d"
        write_c3d(path, Take(points, tuple(f"*{n + 1}" for n in range(points.shape[1])), RATE_HZ))
        result = mocapfix.clean(path, marker_set="cmu41", feet="lock")
    cleaned = result.take.markers[:, [result.take.labels.index(label) for label in truth.labels]]
    distance_m = np.linalg.norm(cleaned - true_m, axis=-1)
    is_measured = np.zeros(distance_m.shape, bool)
    frames, columns = np.nonzero(sources >= 0)
    is_measured[frames, sources[frames, columns]] = True
    is_right = distance_m < SAME_POINT_M
    right_percent = 100 * is_right[is_measured].mean()
    error_mm = compute_error_mm(cleaned, true_m)
    ghosts = (sources < 0) & np.isfinite(points[..., 0])
    frame = int(np.argmax(np.where(ghosts.any(axis=1), (~is_measured).sum(axis=1), 0)))
    before = Panel("Before", f"{points.shape[1]} pieces", ("without a label", "ghost"))
    after = Panel("After", f"{right_percent:.3g} % right", ("labelled", "estimated"))
    before.add_balls(points[frame, ~ghosts[frame]], UNLABELLED, 0.019)
    before.add_balls(points[frame, ghosts[frame]], FAULTY, 0.019)
    joints = name_joints(result.subject.skeleton.names, result.joint_position_world[frame])
    after.add_body(joints)
    is_shown = is_right[frame] & is_measured[frame]
    after.add_balls(cleaned[frame, is_shown], RELABELLED, 0.019)
    after.add_balls(cleaned[frame, ~is_shown], ESTIMATED, 0.019)
    for label in UNLABELLED_NAMED:
        m = truth.labels.index(label)
        column = np.flatnonzero(sources[frame] == m)
        shift = (26, 0) if label.startswith(("L", "C")) else (-28, 0)
        if len(column):
            before.add_label(f"*{column[0] + 1}", points[frame, column[0]], "#8a5a10", shift)
        after.add_label(label, cleaned[frame, m], RELABELLED if is_shown[m] else ESTIMATED, shift)
    centre = joints["Hips"] * [1, 0, 1] + [0.0, 0.87, 0.0]
    save_picture("unlabelled", studio.draw((before, after), 2 * [View(centre, 4.0, 20.0)]))
    return (
        f"A take of {len(truth.labels)} markers without labels: {points.shape[1]} pieces of trajectories in random order, ghosts among "
        f"them. mocapfix finds the person, labels {right_percent:.3g} % of the points rightly, joins the pieces and fills what is "
        f"between them; all markers together are {error_mm:.1f} mm from the truth."
    )


FLIP_S, FLIPPED, FLIP_DEG = (4.75, 5.35), "RightArm", 150.0
ANIMATION_RATE_HZ = 60.0


def make_animation(studio: Studio) -> str:
    """Draw an animation in which an arm flips, and return the caption."""
    truth = compose_take(seed=7, seconds=7.0, rate=ANIMATION_RATE_HZ)
    skeleton, motion = truth.subject.skeleton, truth.motion
    frames = slice(*(round(time_s * ANIMATION_RATE_HZ) for time_s in FLIP_S))
    with TemporaryDirectory() as name:
        folder = Path(name)
        rotations = motion.local_rotations.copy()
        flipped = skeleton.find_joint(FLIPPED)
        rotations[frames, flipped] = Rotation.from_euler("X", FLIP_DEG, degrees=True).as_matrix() @ rotations[frames, flipped]
        write_bvh(folder / "reach.bvh", skeleton, replace(motion, local_rotations=rotations), ANIMATION_RATE_HZ)
        cleaned = mocapfix.clean(folder / "reach.bvh").write(folder / "cleaned")["bvh"]
        animations = [read_bvh(each) for each in (folder / "reach.bvh", cleaned)]
    true_m = truth.joint_positions
    positions = [animation.compute_world_poses()[0] for animation in animations]
    arm = [skeleton.find_joint(joint) for joint in ("RightForeArm", "RightHand")]
    errors_mm = [compute_error_mm(each[frames][:, arm], true_m[frames][:, arm]) for each in positions]
    middle = frames.stop - 10
    panels = (Panel("Before", f"error {errors_mm[0]:.0f} mm", ("faulty",)), Panel("After", f"error {errors_mm[1]:.0f} mm", ("repaired",)))
    for panel, position, colour in zip(panels, positions, (FAULTY, ESTIMATED), strict=True):
        panel.add_body(name_joints(skeleton.names, position[middle]), marked=("RightArm", "RightForeArm", "RightHand"), mark=colour)
        hand = position[:, arm[1]]
        panel.add_trail(hand[frames.start - 1 : frames.stop + 1], colour)
    centre = true_m[middle, skeleton.find_joint("Hips")] * [1, 0, 1] + [-0.1, 0.95, 0.0]
    save_picture("animation", studio.draw(panels, 2 * [View(centre, 4.2, -72.0)]))
    return (
        f"In a BVH file the right arm flips by {FLIP_DEG:.0f} degrees for {FLIP_S[1] - FLIP_S[0]:.1f} s. mocapfix removes the rotation and "
        f"keeps the motion within: elbow and hand were {errors_mm[0]:.0f} mm from the truth and are now {errors_mm[1]:.1f} mm."
    )


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
    path.write_text(yaml.safe_dump(figure | {"name": "figure", "title": "Figure with short legs"}), encoding="utf-8")


def measure_slide_mm(position: Float[np.ndarray, "T J 3"], contacts: Sequence[tuple[int, int, int]]) -> float:
    """Return how far a joint in contact gets from where it first stood, on the floor: the mean over contacts (joint, first, last)."""
    ways = [position[first : last + 1, joint] - position[first, joint] for joint, first, last in contacts]
    return float(np.mean([np.linalg.norm(way[:, [0, 2]], axis=1).max() for way in ways]) * 1e3)


def make_character(studio: Studio) -> str:
    """Draw a clip of a character with short legs, with copied rotations and retargeted, and return the caption."""
    truth = compose_take(seed=2, seconds=5.0, rate=RATE_HZ)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "walk.c3d"
        write_c3d(path, Take(truth.marker_positions, truth.labels, RATE_HZ))
        result = mocapfix.clean(path, feet="lock")
        write_short_legged_figure(Path(folder) / "figure.yaml")
        figure = load_character(Path(folder) / "figure.yaml")
    source, performed = build_cmu31_character(result.subject.skeleton), convert_motion(result.motion, RATE_HZ)
    motions = (copy_rotations(source, performed, figure), retarget_motion(source, performed, figure, contacts=result.contacts))
    positions = [compute_character_poses(figure, motion)[0] for motion in motions]
    balls = {joint: figure.find_bone(f"mixamorig:{joint}") for joint in ("LeftToeBase", "RightToeBase")}
    contacts = [(balls[joint], *interval) for joint in balls for interval in result.contacts.list_intervals(joint)]
    slides_mm = [measure_slide_mm(position, contacts) for position in positions]
    names, legends = ("Before: rotations copied", "After"), (("standing foot slides",), ("stands",))
    pictures: list[Image.Image] = []
    shown = select_frames(CHARACTER_S)
    for frame in range(shown.start, shown.stop, round(RATE_HZ / CLIP_FRAMES_PER_S)):
        panels = [Panel(*each) for each in zip(names, (f"{slide:.0f} mm" for slide in slides_mm), legends, strict=True)]
        views: list[View] = []
        for panel, position, colour in zip(panels, positions, (FAULTY, ESTIMATED), strict=True):
            panel.add_body(name_joints(figure.names, position[frame]), CHARACTER)
            for ball, first, last in contacts:
                if first < frame <= last:
                    way = position[[first, frame], ball] * [1, 0, 1] + [0.0, TRAIL_M, 0.0]
                    panel.add_trail(way, colour, radius=0.012)
                    panel.add_balls(way[:1], colour, 0.022)
            centre = position[frame, figure.find_bone("mixamorig:Hips")] * [0, 0, 1] + [0.0, 0.62, 0.0]
            views.append(View(centre, 3.3, 62.0, 14.0))
        pictures.append(studio.draw(panels, views, pixel_ratio=1))
    save_clip("character", pictures)
    return (
        f"The walk is put on a character whose legs have {100 * LEG_SCALE:.0f} % of their length. With copied rotations a standing foot slides by "
        f"{slides_mm[0]:.0f} mm in a step. mocapfix scales the places of the feet and solves for them: it slides by {slides_mm[1]:.0f} mm."
    )


@contextmanager
def open_review(studio: Studio, folder: Path) -> Iterator[Page]:
    """Serve the review of a cleaned take, and yield its page once it is complete."""
    server = ReviewServer(ReviewSession(folder))
    thread = threading.Thread(target=server.serve, daemon=True)
    thread.start()
    # Playwright evaluates expressions, which the page's policy forbids.
    context = studio.browser.new_context(viewport=REVIEW_SIZE, device_scale_factor=1.25, bypass_csp=True, color_scheme="dark")
    page = context.new_page()
    page.goto(server.address)
    page.wait_for_function("review.getState().isComplete")
    yield page
    context.close()
    server.stop()
    thread.join()


REVIEW_SIZE: ViewportSize = {"width": 1280, "height": 800}
SESSION_WIDTH = 1440
SESSION_PICTURES = {"session-page-before": 760, "session-page": 1240}  # and their heights
CLEANING_TIMEOUT_MS = 120_000
REVIEWED_CHANGE = "gap-LWRA-121"


def make_review_page(studio: Studio) -> str:
    """Take pictures of the review page before and after a technician rejects a fill, and return the caption."""
    with TemporaryDirectory() as folder, chdir(folder):
        run_demo()
        with open_review(studio, Path("demo.mocapfix")) as page:
            for name in ("review-page", "review-page-after"):
                page.evaluate("name => review.app.select(name)", REVIEWED_CHANGE)
                page.evaluate("review.app.scene.frameMarkers(null, [0.7, 0.2, 1])")
                page.evaluate("review.app.scene.camera.position.lerp(review.app.scene.controls.target, 0.12)")
                page.wait_for_timeout(1000)
                save_page(name, page)
                if name == "review-page":
                    page.keyboard.press("r")
                    page.wait_for_function("review.getState().take.changes.some(each => each.is_reviewed)")
                    page.keyboard.press("c")
                    page.wait_for_function("document.body.innerText.includes('Cleaned again')", timeout=CLEANING_TIMEOUT_MS)
                    page.wait_for_timeout(2000)
    return (
        "A technician goes through the changes, the least certain first, and rejects the fill of a wrist marker "
        "with R. Cleaned again with C, the marker stays empty there, and everything else is as it was."
    )


SESSION_TAKES = ("jim/walk", "jim/reach", "ann/walk", "ann/turn")


def make_session_page(studio: Studio) -> str:
    """Take pictures of the page of a session before and after a damaged take was exported again, and return the caption."""
    page = studio.browser.new_page(device_scale_factor=1.25)
    with TemporaryDirectory() as folder, chdir(folder):
        for n, name in enumerate(SESSION_TAKES):
            take = Path(f"{name}.c3d")
            take.parent.mkdir(exist_ok=True)
            write_synthetic_take(take, compose_take(seed=20 + n // 2, seconds=5.0 + n, rate=RATE_HZ))
        session = {"kind": "session", "title": "Monday, two actors", "takes": ["*/*.c3d"]}
        Path("monday.yaml").write_text(yaml.safe_dump(session), encoding="utf-8")
        sound = take.read_bytes()
        take.write_bytes(sound[: len(sound) // 3])
        for picture, height in SESSION_PICTURES.items():
            subprocess.run([sys.executable, "-m", "mocapfix", "batch", "monday.yaml", "--out", "cleaned"], check=False)
            page.set_viewport_size({"width": SESSION_WIDTH, "height": height})
            page.goto(Path("cleaned/index.html").resolve().as_uri())
            page.evaluate("folder => { document.body.innerHTML = document.body.innerHTML.replaceAll(folder, ''); }", f"{Path.cwd()}/")
            save_page(picture, page)
            take.write_bytes(sound)
    return (
        f"Of {len(SESSION_TAKES)} takes of a session three are cleaned, and one is refused with a sentence that says why: its file is cut off. "
        "The take is exported again and the same command repeated: it cleans what is missing, and every take is done."
    )


EXHIBITS: dict[str, Callable[[Studio], str]] = {
    "gap": make_gap, "swap": make_swap, "lost-limb": make_lost_limb, "unlabelled": make_unlabelled, "animation": make_animation,
    "character": make_character, "review-page": make_review_page, "session-page": make_session_page,
}  # fmt: skip


def main() -> None:
    """Make the pictures that the command line names, or all, and write their captions."""
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
