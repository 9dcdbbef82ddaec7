"""The whole pipeline on takes with known truth: accuracy, unchanged samples, options and output files."""

import hashlib
import json
import re
import warnings
from collections import Counter
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from mocapfix import pipeline
from mocapfix.errors import OptionError, TakeError, WriteError
from mocapfix.io import capture, changes_file
from mocapfix.io.c3d import write_c3d
from mocapfix.io.patches import patch_c3d
from mocapfix.lab.hands import compose_hands
from mocapfix.model import windows
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.option import FRAME_LIMIT
from mocapfix.options import CleanOptions, FillOptions
from mocapfix.solve import kinematics, person_memory
from mocapfix.solve.lost_in_sight import BODY_PARTS
from mocapfix.stats.sequences import find_runs
from mocapfix.subject import library
from mocapfix.subject.library import load_marker_set
from mocapfix.synthetic import compose_take, compute_fill_errors, write_synthetic_take
from tests.conftest import FIRST_FRAME, build_c3d

OUTPUT_SUFFIXES = {"c3d", "bvh", "subject.yaml", "changes.yaml", "report.json", "report.html", "rrd"}
LONG_GAP_S = 0.5


def build_long_gap_mask(truth):
    """Return the mask (T, M) of the samples in gaps of at least LONG_GAP_S."""
    mask = np.zeros_like(truth.missing_mask)
    for m in range(mask.shape[1]):
        for first, last in find_runs(truth.missing_mask[:, m]):
            mask[first : last + 1, m] = (last - first + 1) / truth.rate >= LONG_GAP_S
    return mask


def compute_errors_mm(truth, result):
    """Return the error table of the demo. The takes of these tests have no missing arm, so its mean there is NaN."""
    with warnings.catch_warnings(action="ignore", category=RuntimeWarning):
        return compute_fill_errors(truth, result)


def compute_digest(path):
    return hashlib.sha256(path.read_bytes()).hexdigest()


def compute_bone_lengths(skeleton):
    return np.linalg.norm(skeleton.offsets, axis=1)


def find_changed_samples(before, after):
    """Return the mask (T, M) of the samples that differ."""
    return ~((before.markers == after.markers) | np.isnan(before.markers) & np.isnan(after.markers)).all(-1)


@pytest.fixture(scope="module")
def subject(brief):
    """Return the calibrated subject of the brief take."""
    return library.read_subject(brief.subject)


# accuracy


@pytest.mark.parametrize(
    ("damage", "linear_ratio", "cubic_ratio", "max_error_mm"),
    [("gaps under 0.5 s", 5, 3, 3), ("one marker lost for 0.5 s and more", 15, 15, 13), ("spikes", 60, 60, 2.5)],
)
def test_errors_are_much_smaller_than_those_of_interpolation(cleaned, damage, linear_ratio, cubic_ratio, max_error_mm):
    errors_mm = {method: errors[damage] for method, errors in compute_errors_mm(cleaned.truth, cleaned.result).items()}
    assert errors_mm["mocapfix"] < errors_mm["linear"] / linear_ratio
    assert errors_mm["mocapfix"] < errors_mm["cubic"] / cubic_ratio
    assert errors_mm["mocapfix"] < max_error_mm


def test_all_gaps_are_filled_and_all_spikes_are_detected(cleaned):
    fill = cleaned.result.subject_report["fill"]
    assert fill["missing_before"] == fill["filled"] == cleaned.truth.missing_mask.sum()
    assert (fill["left_empty"], fill["unfilled"]) == (0, [])
    inliers = cleaned.result.faults.compute_inlier_mask(cleaned.result.input_take)
    np.testing.assert_array_equal(inliers, ~cleaned.truth.missing_mask & ~cleaned.truth.spike_mask)
    assert fill["replaced"] == cleaned.truth.spike_mask.sum()


def test_undamaged_samples_keep_every_bit(cleaned):
    undamaged = ~cleaned.truth.missing_mask & ~cleaned.truth.spike_mask
    before, after = cleaned.result.input_take.markers[undamaged], cleaned.result.take.markers[undamaged]
    assert before.tobytes() == after.tobytes()
    assert np.isnan(cleaned.result.take.sample_sd[undamaged]).all()


def test_joints_are_close_to_the_true_ones_and_as_smooth(cleaned):
    joints, true_joints = cleaned.result.joint_position_world, cleaned.truth.joint_positions
    assert np.linalg.norm(joints - true_joints, axis=-1).mean() < 0.016

    def compute_rms_jerk(positions):
        return np.sqrt((np.diff(positions, 3, axis=0) ** 2).mean())

    assert compute_rms_jerk(joints) < 2.5 * compute_rms_jerk(true_joints)


def test_calibrated_subject_is_closer_to_the_true_one_than_the_mean_body(cleaned):
    calibrated, true_subject = cleaned.result.subject, cleaned.truth.subject
    marker_set = load_marker_set("cmu41")
    true_lengths = compute_bone_lengths(true_subject.skeleton)

    def compute_rms_length_error(skeleton):
        return np.sqrt(((compute_bone_lengths(skeleton) - true_lengths) ** 2).mean())

    assert compute_rms_length_error(calibrated.skeleton) < 0.75 * compute_rms_length_error(load_cmu31_body().skeleton)
    assert np.abs(compute_bone_lengths(calibrated.skeleton) - true_lengths).max() < 0.022
    offset_error = np.linalg.norm(calibrated.marker_offsets - true_subject.marker_offsets, axis=1).mean()
    assert offset_error < 0.7 * np.linalg.norm(marker_set.marker_offsets - true_subject.marker_offsets, axis=1).mean()


@pytest.mark.parametrize("duration", ["short", "long"])
def test_predicted_deviations_match_the_errors(cleaned, duration):
    is_long = build_long_gap_mask(cleaned.truth)
    filled = is_long if duration == "long" else cleaned.truth.missing_mask & ~is_long
    error = np.abs(cleaned.result.take.markers - cleaned.truth.marker_positions)[filled]
    sample_sd = cleaned.result.take.sample_sd[filled][:, None]
    assert 0.45 < (error < sample_sd).mean() < 0.97  # 0.68 for a normal distribution with exactly this deviation
    assert (error < 2 * sample_sd).mean() > 0.9
    assert np.corrcoef(sample_sd[:, 0], error.mean(1))[0, 1] > 0.2  # samples with a greater deviation have greater errors


def test_residuals_in_the_report_are_distances_from_the_body(cleaned):
    result = cleaned.result
    body_markers = kinematics.compute_joint_and_marker_positions(result.subject, result.motion)[1]
    columns = load_marker_set("cmu41").find_columns(result.input_take.labels)
    inliers = result.faults.compute_inlier_mask(result.input_take)[:, columns]
    distance_m = np.linalg.norm(result.input_take.markers[:, columns] - body_markers, axis=-1)[inliers]
    solve = result.subject_report["solve"]
    assert solve is not None
    residual_mm = solve["marker_residual_mm"]
    assert residual_mm["mean"] == pytest.approx(distance_m.mean() * 1e3, abs=1e-3)
    assert residual_mm["p95"] == pytest.approx(np.percentile(distance_m, 95) * 1e3, abs=1e-3)
    assert residual_mm["mean"] < 6.0


# output files


def test_all_files_are_written_and_the_c3d_and_the_bvh_contain_the_result(cleaned):
    assert set(cleaned.outputs) == OUTPUT_SUFFIXES
    names = {path.name for path in cleaned.outputs["c3d"].parent.iterdir()}
    assert names == {f"walk.{suffix}" for suffix in OUTPUT_SUFFIXES}
    take = capture.read_take(cleaned.outputs["c3d"])
    np.testing.assert_allclose(take.markers, cleaned.result.take.markers, atol=1e-6)
    assert (take.labels, take.rate, take.first_frame) == (cleaned.truth.labels, cleaned.truth.rate, 1)
    text = cleaned.outputs["bvh"].read_text(encoding="ascii")
    rows = np.array([line.split() for line in text.split("Frame Time:")[1].splitlines()[1:]], float)
    assert f"Frames: {cleaned.result.input_take.frame_count}\nFrame Time: 0.00833333" in text
    np.testing.assert_allclose(rows[:, :3] / 100, cleaned.result.motion.root_position, atol=1e-7)
    assert np.abs(np.diff(rows[:, 3:], axis=0)).max() < 90  # degrees from frame to frame


def test_output_files_have_the_stem_of_the_input_and_the_input_is_unchanged(brief, subject, tmp_path):
    source = tmp_path / "a.b.c3d"
    source.write_bytes(brief.path.read_bytes())
    digest = compute_digest(source)
    result = pipeline.clean(source, subject=subject)
    outputs = result.write(tmp_path / "deep" / "out")
    assert {suffix: path.name for suffix, path in outputs.items()} == {suffix: f"a.b.{suffix}" for suffix in OUTPUT_SUFFIXES}
    assert all(path.stat().st_size > 0 for path in outputs.values())
    assert compute_digest(source) == digest
    with pytest.raises(WriteError, match=r"would replace the input file"):
        result.write(tmp_path, overwrite=True)
    assert compute_digest(source) == digest
    assert {path.name for path in tmp_path.iterdir()} == {"a.b.c3d", "deep"}


def test_no_file_is_written_if_one_of_them_exists(brief, subject, tmp_path):
    result = pipeline.clean(brief.path, subject=subject)
    existing = tmp_path / "brief.bvh"
    existing.write_text("mine", encoding="utf-8")
    with pytest.raises(WriteError, match=r"brief\.bvh: already exists; give --overwrite"):
        result.write(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["brief.bvh"]
    assert existing.read_text(encoding="utf-8") == "mine"
    result.write(tmp_path, overwrite=True)
    assert existing.read_text(encoding="utf-8").startswith("HIERARCHY")


def test_written_report_is_that_of_the_result_in_strict_json(cleaned):
    def refuse(constant):
        raise AssertionError(f"{constant} is no JSON")

    written = json.loads(cleaned.outputs["report.json"].read_text(encoding="utf-8"), parse_constant=refuse)
    report = json.loads(json.dumps(cleaned.result.report))
    arguments = written.pop("arguments")
    assert (cleaned.outputs["report.json"].parent / arguments[0]).samefile(cleaned.path)
    assert {**written, "seconds": None, "times": None} == {**report, "seconds": None, "times": None}
    assert not {"write", "show"} & set(report["seconds"])  # writing does not change the result
    keys = ["take", "faults", "changes", "subject", "solve", "fill", "seconds", "times", "notes", "contacts", "corrections"]
    assert list(written) == keys
    assert {"read", "calibrate", "solve", "fill", "write", "show"} <= set(written["seconds"])
    assert written["seconds"]["total"] == pytest.approx(sum(v for k, v in written["seconds"].items() if k != "total"), abs=1e-3)
    by_stage = Counter[str]()
    for part, time in written["times"].items():
        by_stage[part.split("/")[0]] += time["seconds"]
    assert by_stage == pytest.approx({stage: s for stage, s in written["seconds"].items() if stage != "total"}, abs=1e-2)
    assert {"detect/trajectories", "solve/poses", "solve/limbs and feet", "write/bvh", "show/report.html"} <= set(
        written["times"]
    )


def test_report_has_the_frame_numbers_of_the_file(brief, subject):
    report = pipeline.clean(brief.path, subject=subject, max_gap_s=0.1).subject_report
    assert report["take"]["first_frame"] == FIRST_FRAME
    faults = {(each["kind"], each["marker"], each["first"], each["last"]) for each in report["faults"]}
    assert {("gap", "RELB", 341, 360), ("gap", "LKNE", 371, 390), ("spike", "STRN", 321, 321)} <= faults
    unfilled = {(each["marker"], each["first"], each["last"], each["reason"]) for each in report["fill"]["unfilled"]}
    reason = "the gap is longer than 0.1 s"
    assert unfilled == {("RELB", 341, 360, reason), ("LKNE", 371, 390, reason)}


# unchanged samples


def test_cleaning_an_output_again_changes_nothing(faulty, tmp_path):
    result = pipeline.clean(faulty.output, subject=faulty.subject)
    assert result.changes == ()
    assert patch_c3d(tmp_path / "again.c3d", result.input_take, result.take) == []
    assert (tmp_path / "again.c3d").read_bytes() == faulty.output.read_bytes()


def test_a_take_without_faults_keeps_every_byte(cleaned, tmp_path):
    source = tmp_path / "sound.c3d"
    source.write_bytes(build_c3d(cleaned.truth.marker_positions[200:440], cleaned.truth.labels))
    result = pipeline.clean(source)
    assert (result.faults.items, result.changes, result.unfilled_runs) == ((), (), ())
    assert patch_c3d(tmp_path / "again.c3d", result.input_take, result.take) == []
    assert (tmp_path / "again.c3d").read_bytes() == source.read_bytes()


def test_changes_in_the_report_cover_exactly_the_samples_that_differ(cleaned):
    before, after = (capture.read_take(path) for path in (cleaned.path, cleaned.outputs["c3d"]))
    columns = {label: m for m, label in enumerate(before.labels)}
    change_count = np.zeros(before.visible.shape, int)
    for change in cleaned.result.subject_report["changes"]:
        frames = slice(change["first"] - before.first_frame, change["last"] - before.first_frame + 1)
        change_count[frames, [columns[label] for label in change["markers"]]] += 1
        assert change["samples"] == (change["last"] - change["first"] + 1) * len(change["markers"])
    np.testing.assert_array_equal(change_count, find_changed_samples(before, after))


# a marker that moves on its segment

SHIFT_FRAME = 240
SHIFT_M = (0.0, -0.04, 0.0)  # in the axes of the thorax
HIDDEN_RUNS = ((100, 119), (SHIFT_FRAME - 6, SHIFT_FRAME + 5), (330, 349))


@pytest.fixture(scope="module")
def shifted(tmp_path_factory):
    """Return the path, the truth and the marker positions of a take of 8 s in which T10 moves down by 40 mm.

    T10 is hidden while it moves, once before, and once after.
    """
    truth = compose_take(seed=3, seconds=8.0, rate=60.0)
    path, marker = tmp_path_factory.mktemp("shifted") / "shifted.c3d", truth.labels.index("T10")
    positions = truth.marker_positions.copy()
    rotations = kinematics.compute_world_poses(truth.subject.skeleton, truth.motion)[1]
    positions[SHIFT_FRAME:, marker] += rotations[SHIFT_FRAME:, truth.subject.joints[marker]] @ np.array(SHIFT_M)
    measured = positions.copy()
    for first, last in HIDDEN_RUNS:
        measured[first : last + 1, marker] = np.nan
    path.write_bytes(build_c3d(measured, truth.labels, rate=60.0))
    return path, truth, positions


def clean_shifted(shifted, **options):
    """Return the result and the distances (T,) of T10 from its true positions in metres. Visible samples must not change."""
    path, truth, positions = shifted
    result = pipeline.clean(path, subject=truth.subject, **options)
    marker = truth.labels.index("T10")
    is_hidden = np.zeros(len(positions), bool)
    for first, last in HIDDEN_RUNS:
        is_hidden[first : last + 1] = True
    np.testing.assert_array_equal(result.take.markers[~is_hidden], result.input_take.markers[~is_hidden])
    return result, np.linalg.norm(result.take.markers[:, marker] - positions[:, marker], axis=-1)


def test_a_moved_marker_is_detected_and_filled_at_both_positions(shifted):
    result, error_m = clean_shifted(shifted)
    changes = {change.kind: change for change in result.changes}
    assert abs(changes["moved"].first - 1 - SHIFT_FRAME) <= 6
    assert (changes["moved"].markers, changes["moved"].last, changes["moved"].samples) == (("T10",), 480, 0)
    for first, last in (HIDDEN_RUNS[0], HIDDEN_RUNS[2]):
        assert error_m[first : last + 1].max() < 0.01
    assert result.unfilled_runs == ()
    assert np.linalg.norm(result.joint_position_world - shifted[1].joint_positions, axis=-1).mean() < 0.006


def test_max_gap_applies_to_the_whole_gap_of_a_moved_marker(shifted):
    result, error_m = clean_shifted(shifted, max_gap_s=0.25)
    first, last = HIDDEN_RUNS[1]
    assert not np.isnan(error_m[first : last + 1]).any()
    assert [(run.first, run.last, run.reason) for run in result.unfilled_runs] == [
        (first, last, "the gap is longer than 0.25 s") for first, last in (HIDDEN_RUNS[0], HIDDEN_RUNS[2])
    ]
    unfilled = [(run.first, run.last) for run in clean_shifted(shifted, max_gap_s=0.15)[0].unfilled_runs]
    assert unfilled == list(HIDDEN_RUNS)


def test_a_rejected_marker_shift_is_not_applied(shifted, tmp_path):
    result, _ = clean_shifted(shifted)
    path = tmp_path / "review.yaml"
    reviewed = [replace(each, decision="reject" if each.kind == "moved" else "accept") for each in result.changes]
    changes_file.write_changes_file(path, result.input_take, reviewed)
    result, _ = clean_shifted(shifted, review_files=path)
    assert not result.faults.select_kinds("moved", "drift")
    assert {change.kind: change.decision for change in result.changes} == {"gap": "accept", "moved": "reject"}


# options that restrict the changes


def list_changed_frames(result):
    """Return the frame numbers of the changed samples by label."""
    take, is_changed = result.input_take, find_changed_samples(result.input_take, result.take)
    changed_markers = np.flatnonzero(is_changed.any(0))
    return {take.labels[m]: (np.flatnonzero(is_changed[:, m]) + FIRST_FRAME).tolist() for m in changed_markers}


RELB_FRAMES = list(range(341, 361))
LKNE_FRAMES = list(range(371, 391))
STRN_FRAMES = [321]


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (FillOptions(), {"RELB": RELB_FRAMES, "LKNE": LKNE_FRAMES, "STRN": STRN_FRAMES}),
        (FillOptions(keep=("RELB", "STRN")), {"LKNE": LKNE_FRAMES}),
        (FillOptions(frames=(350, 380)), {"RELB": RELB_FRAMES[9:], "LKNE": LKNE_FRAMES[:10]}),
        (FillOptions(frames=(-(2**62), 340)), {"STRN": STRN_FRAMES}),
        (FillOptions(frames=(321, 321), keep=("STRN",)), {}),
        (FillOptions(max_gap_s=0.1), {"STRN": STRN_FRAMES}),
        (FillOptions(max_gap_s=20 / 120), {"RELB": RELB_FRAMES, "LKNE": LKNE_FRAMES, "STRN": STRN_FRAMES}),
    ],
    ids=["all", "keep", "frames", "until", "keep in frames", "max-gap", "max-gap, exactly"],
)
def test_options_restrict_which_samples_are_changed(brief, subject, options, expected):
    result = pipeline.clean(brief.path, subject=subject, options=CleanOptions(fill=options))
    assert list_changed_frames(result) == expected
    fill = result.subject_report["fill"]
    assert fill["filled"] == sum(len(expected.get(label, ())) for label in ("RELB", "LKNE"))
    assert fill["replaced"] == len(expected.get("STRN", ()))
    assert fill["left_empty"] == fill["missing_before"] - fill["filled"]
    assert sum(each["last"] - each["first"] + 1 for each in fill["unfilled"]) == fill["left_empty"]


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (FillOptions(keep=("RELB", "NOSE")), "brief.c3d: has no marker NOSE to keep; its markers are "),
        (FillOptions(frames=(1, 300)), "brief.c3d: --frames 1:300 is not in the take, which has frames 301 to 420."),
        (FillOptions(frames=(421, 500)), "brief.c3d: --frames 421:500 is not in the take, which has frames 301 to 420."),
        (FillOptions(frames=(421, FRAME_LIMIT)), "brief.c3d: --frames 421: is not in the take, which has frames 301 to 420."),
    ],
)
def test_markers_and_frames_that_the_take_does_not_have_are_errors(brief, options, sentence):
    with pytest.raises(TakeError, match=re.escape(sentence)):
        pipeline.clean(brief.path, options=CleanOptions(fill=options))


# subjects and marker sets


def test_a_known_subject_keeps_its_bones_and_is_not_calibrated(cleaned, brief, subject):
    result = pipeline.clean(brief.path, subject=brief.subject)
    assert result.subject is not None
    np.testing.assert_array_equal(result.subject.skeleton.offsets, subject.skeleton.offsets)
    np.testing.assert_allclose(result.subject.skeleton.offsets, cleaned.result.subject.skeleton.offsets, atol=1e-7)
    np.testing.assert_array_equal(result.subject.marker_offsets, subject.marker_offsets)
    assert "calibrate" not in result.subject_report["seconds"]
    assert result.subject_report["take"]["marker_set"] == "cmu41"


def test_arm_with_jitter_on_all_markers_is_solved(tmp_path):
    truth, path = compose_take(seed=3, seconds=4.0), tmp_path / "jitter.c3d"
    arm, positions = [truth.labels.index(f"L{name}") for name in ("FRM", "WRA", "WRB", "FIN")], truth.marker_positions.copy()
    positions[120:360, arm] += np.random.default_rng(0).normal(0, 0.02, (240, 4, 3))
    no_samples = np.zeros_like(truth.missing_mask)
    damaged = replace(truth, missing_mask=no_samples, damaged_positions=positions, spike_mask=no_samples)
    write_synthetic_take(path, damaged)
    result = pipeline.clean(path, subject=truth.subject)
    assert Counter(fault.kind for fault in result.faults.items) == {"jitter": 4}
    hand = truth.subject.skeleton.find_joint("LeftHand")
    assert result.joint_position_world is not None
    error_m = np.linalg.norm(result.joint_position_world[120:360, hand] - truth.joint_positions[120:360, hand], axis=1)
    assert error_m.mean() < 0.015  # 0.025 if the solve did not use these markers
    is_replaced = (result.take.markers != result.input_take.markers).any(axis=2)
    assert is_replaced[120:360, arm].mean() > 0.9


def test_two_takes_of_a_person_are_calibrated_together(cleaned, brief):
    calibrated = pipeline.calibrate_takes([brief.path, cleaned.path])
    assert calibrated.labels == load_marker_set("cmu41").labels
    length_error_m = compute_bone_lengths(calibrated.skeleton) - compute_bone_lengths(cleaned.truth.subject.skeleton)
    assert np.abs(length_error_m).max() < 0.025


def test_calibration_from_no_take_is_refused():
    with pytest.raises(TakeError, match="no take to calibrate from"):
        pipeline.calibrate_takes([])


def test_a_take_that_matches_no_marker_set_is_cleaned_without_a_body(cleaned, tmp_path):
    source = tmp_path / "prop.c3d"
    source.write_bytes(build_c3d(cleaned.truth.damaged_positions, [f"P{n + 1}" for n in range(41)]))
    result = pipeline.clean(source, known_sets_only=True)
    assert (result.subject, result.motion, result.joint_position_world, result.residual_m) == (None, None, None, None)
    report = result.subject_report
    assert (report["take"]["marker_set"], report["subject"], report["solve"]) == (None, None, None)
    first, second = result.subject_report["notes"][:2]
    assert first.startswith("No marker set fits the labels P1, P2 and 39 more: none of them is in a shipped set")
    assert second == "The take was cleaned without a skeleton: there is no BVH."
    assert not any("Preview" in note for note in report["notes"])
    preview = pipeline.clean(source, known_sets_only=True, is_fast=True)
    assert (
        "Preview without a skeleton: gaps are filled as in a full clean, and faults are detected in one round."
        in preview.subject_report["notes"]
    )
    outputs = result.write(tmp_path / "out")
    assert set(outputs) == OUTPUT_SUFFIXES - {"bvh", "subject.yaml"}
    assert {path.name for path in (tmp_path / "out").iterdir()} == {f"prop.{suffix}" for suffix in outputs}
    errors_mm = compute_errors_mm(cleaned.truth, result)
    short, long = "gaps under 0.5 s", "one marker lost for 0.5 s and more"
    assert errors_mm["mocapfix"][short] < errors_mm["cubic"][short] / 2
    assert errors_mm["mocapfix"][long] < errors_mm["linear"][long] / 4
    undamaged = ~cleaned.truth.missing_mask & ~cleaned.truth.spike_mask
    assert result.input_take.markers[undamaged].tobytes() == result.take.markers[undamaged].tobytes()


def test_a_take_with_unknown_labels_is_cleaned_with_a_set_of_its_own(cleaned, tmp_path):
    source, order = tmp_path / "unknown.c3d", np.random.default_rng(0).permutation(41)
    source.write_bytes(build_c3d(cleaned.truth.damaged_positions[:, order], [f"P{n + 1}" for n in range(41)]))
    result = pipeline.clean(source)
    assert result.subject is not None
    true_joint = dict(zip((f"P{n + 1}" for n in range(41)), cleaned.truth.subject.joints[order], strict=True))
    correct = [true_joint[label] == joint for label, joint in zip(result.subject.labels, result.subject.joints, strict=True)]
    assert sum(correct) >= 38
    assert any(note.startswith("A marker set was learned from this take: ") for note in result.subject_report["notes"])
    undamaged = ~cleaned.truth.missing_mask[:, order] & ~cleaned.truth.spike_mask[:, order]
    assert (result.input_take.markers[undamaged] != result.take.markers[undamaged]).any(-1).mean() < 1e-3


@pytest.mark.parametrize(
    ("kept_count", "name", "note"),
    [
        (40, "cmu41", "40 of its 40 markers were found."),
        (0, None, "A marker set learned from this take would reject or relabel measured samples, so it is not used."),
    ],
)
def test_inspection_names_the_learned_set_that_is_used(brief, monkeypatch, kept_count, name, note):
    learned = load_marker_set("cmu41")
    kept = learned.select_markers(learned.labels[:kept_count]) if kept_count else None
    choice = library.SubjectChoice(None, learned, ("No marker set fits.",), is_learned=True)
    monkeypatch.setattr(pipeline, "identify_subject", lambda *_: choice)
    monkeypatch.setattr(pipeline, "select_consistent_set", lambda own, *_: own if own.labels[kept_count:] == () else kept)
    (inspection,) = pipeline.inspect(brief.path, is_fast=True)
    assert inspection["take"]["marker_set"] == name
    assert inspection["notes"][-1].endswith(note)


def test_a_take_of_feet_only_is_cleaned_without_a_body(cleaned, tmp_path):
    foot_labels = ("KNE", "ANK", "HEE", "TOE", "MT5")
    feet = [m for m, label in enumerate(cleaned.truth.labels) if label[1:] in foot_labels]
    source = tmp_path / "feet.c3d"
    source.write_bytes(build_c3d(cleaned.truth.damaged_positions[:, feet], [cleaned.truth.labels[m] for m in feet]))
    result = pipeline.clean(source)
    assert result.subject is None
    first, second, third = result.subject_report["notes"]
    assert re.search(r"the nearest is cmu41 with \d+ of its 41 markers, but the .*thorax.* cannot be located\.$", first)
    assert second.startswith("No marker set can be learned: the words in the labels locate LKNE, ")
    assert third == "The take was cleaned without a skeleton: there is no BVH."
    fill = result.subject_report["fill"]
    assert fill["filled"] > 0.5 * fill["missing_before"] > 0
    assert sum(each["last"] - each["first"] + 1 for each in fill["unfilled"]) == fill["left_empty"]
    assert all(each["reason"] for each in fill["unfilled"])


def test_a_requested_marker_set_must_fit(brief):
    with pytest.raises(TakeError, match=r"^brief\.c3d: qualisys-sports does not fit: \d+ of its \d+ markers, .*not found: "):
        pipeline.clean(brief.path, marker_set="qualisys-sports")


def test_labels_exchanged_in_the_whole_take_are_corrected_or_reported_where_they_are_kept(brief, subject, tmp_path):
    labels = list(brief.labels)
    knee, shoulder = labels.index("LKNE"), labels.index("RSHO")
    labels[knee], labels[shoulder] = labels[shoulder], labels[knee]
    source, review_path = tmp_path / "swapped.c3d", tmp_path / "review.yaml"
    source.write_bytes(build_c3d(brief.markers, labels))
    result = pipeline.clean(source, subject=subject)
    change = {change.kind: change for change in result.changes}["mislabelled"]
    assert (set(change.markers), change.first, change.last) == ({"LKNE", "RSHO"}, 1, 120)
    visible = ~np.isnan(brief.markers[:, knee, 0])
    np.testing.assert_allclose(result.take.markers[visible, shoulder], brief.markers[visible, knee], atol=1e-6)
    assert result.subject_report["notes"] == []
    changes_file.write_changes_file(review_path, result.input_take, [replace(change, decision="keep")])
    notes = " ".join(pipeline.clean(source, subject=subject, review_files=review_path).subject_report["notes"])
    for label in ("LKNE", "RSHO"):
        assert f"{label} is more than 60 mm from the body in most of its frames; check its label." in notes


# stages and options of the solve


def test_progress_is_reported_in_the_order_of_the_stages(brief):
    stages = []
    pipeline.clean(brief.path, progress=stages.append)
    before, after = ["read", "label", "detect/trajectories", "calibrate", "initialise"], ["solve/limbs and feet", "solve/hands"]
    assert stages == [*before, "solve/poses", "detect/body", "detect/hands", *after, "fill"]


def test_an_unknown_initialisation_method_is_an_error_before_the_file_is_read():
    with pytest.raises(OptionError, match=r"method must be one of .*learned, registration, not 'hybrik'"):
        pipeline.clean("nowhere.c3d", init_method="hybrik")


def test_the_initialisation_method_is_used_and_reported(brief):
    methods = ("registration", "hybrik-x")
    results = {method: pipeline.clean(brief.path, subject=brief.subject, init_method=method) for method in methods}
    for method, result in results.items():
        solve = result.subject_report["solve"]
        assert solve is not None
        assert solve["start"] == method
    joints = [result.joint_position_world for result in results.values()]
    assert joints[0] is not None
    assert joints[1] is not None
    np.testing.assert_allclose(joints[1], joints[0], atol=2e-3)


@pytest.mark.parametrize("prior_scale", [0.0, -1.0, float("nan"), float("inf")])
def test_an_invalid_prior_scale_is_an_error_before_the_file_is_read(prior_scale):
    with pytest.raises(OptionError, match="prior_scale must be greater than 0 and finite, not "):
        pipeline.clean("nowhere.c3d", prior_scale=prior_scale)


def test_subject_before_another_separator_is_known_and_kept_in_the_file(brief, tmp_path):
    path = tmp_path / "jim.c3d"
    path.write_bytes(build_c3d(brief.markers, [f"Jim_{label}" for label in brief.labels], first=FIRST_FRAME))
    result = pipeline.clean(path, subject=brief.subject, keep=("LKNE",), subject_prefix="jim")
    assert {change.markers for change in result.changes} == {("Jim_RELB",), ("Jim_STRN",)}
    result.write(tmp_path / "out")
    assert capture.read_take(tmp_path / "out" / "jim.c3d").labels == tuple(f"Jim_{label}" for label in brief.labels)


def test_the_memory_of_another_person_is_not_used(brief, tmp_path):
    remembered = pipeline.remember_take(brief.path, "other", CleanOptions().change(subject=brief.subject))[""]
    larger = replace(remembered, bone_lengths_m=np.float32(1.2) * remembered.bone_lengths_m)
    person_memory.write_memory(tmp_path / "p.safetensors", larger)
    result = pipeline.clean(brief.path, subject=brief.subject, person_memory=tmp_path / "p.safetensors")
    note = "The memory of other is another person's, whose bones differ by 18%: it was not used."
    assert note in result.subject_report["notes"]


@pytest.fixture(scope="module")
def windowed(cleaned, tmp_path_factory):
    """Return the result of cleaning the take of `cleaned` in windows of 2 s, the output files, and the frames of the cuts."""
    folder = tmp_path_factory.mktemp("windowed")
    with pytest.MonkeyPatch.context() as patch:
        for name, value in (("OVERLAP_S", 1.0), ("MIN_SHOWN_S", 1.0), ("CUT_SEARCH_S", 0.3)):
            patch.setattr(windows, name, value)
        patch.setattr(capture, "MAX_PIECE_FRAMES", 300)
        patch.setattr(pipeline, "plan_windows", partial(windows.plan_windows, window_frames=240))
        result = pipeline.clean(cleaned.path)
        plan = pipeline.plan_windows(result.input_take.visible, result.input_take.rate)
        return result, result.write(folder), [window.start for window in plan[1:]]


def test_a_take_in_windows_is_cleaned_as_in_one_piece(cleaned, windowed):
    one, many = cleaned.result, windowed[0]
    (note,) = [note for note in many.report["notes"] if note.startswith("Cleaned in 3 windows")]
    assert "6 s of the take" in note
    assert np.array_equal(one.take.visible, many.take.visible)
    assert np.allclose(one.take.markers, many.take.markers, atol=0.02, equal_nan=True)
    fills = one.take.sample_sd > 0
    errors_mm = [1e3 * np.linalg.norm(each.take.markers - cleaned.truth.marker_positions, axis=-1)[fills] for each in (one, many)]
    assert errors_mm[1].mean() < 1.1 * errors_mm[0].mean()
    assert np.linalg.norm(one.joint_position_world - many.joint_position_world, axis=-1).mean() < 0.001
    of_one, of_many = ([(each.id, each.samples, each.why) for each in result.changes] for result in (one, many))
    assert of_many == of_one
    for key in ("missing_before", "filled", "replaced", "relabelled", "left_empty"):
        assert many.report["fill"][key] == one.report["fill"][key]
    assert len(many.report["faults"]) == len(one.report["faults"])


def test_a_remembered_gap_over_the_cuts_of_windows_is_one(cleaned, tmp_path, monkeypatch):
    truth, known = cleaned.truth, tmp_path / "known.yaml"
    library.write_subject(known, truth.subject)
    memory = pipeline.remember_take(cleaned.path, "whole", CleanOptions().change(subject=known))[""]
    person_memory.write_memory(tmp_path / "p.safetensors", memory)
    markers, names = truth.marker_positions.copy(), truth.subject.skeleton.names
    arm = [k for k, j in enumerate(truth.subject.joints) if names[j] in BODY_PARTS["left arm"]]
    markers[150:550, arm] = np.nan
    (tmp_path / "lost.c3d").write_bytes(build_c3d(markers, truth.labels, first=11))
    for name in ("OVERLAP_S", "MAX_OVERLAP_S", "MIN_SHOWN_S"):
        monkeypatch.setattr(windows, name, 1.0)
    monkeypatch.setattr(capture, "MAX_PIECE_FRAMES", 300)
    monkeypatch.setattr(pipeline, "plan_windows", partial(windows.plan_windows, window_frames=240))
    result = pipeline.clean(tmp_path / "lost.c3d", subject=known, person_memory=tmp_path / "p.safetensors")
    (note,) = [each for each in result.subject_report["notes"] if each.startswith("Inferred from the memory")]
    assert "left arm in frames 161\u2013560 from whole" in note
    assert note.count("left arm") == 1


def test_motion_and_fills_go_on_over_the_cuts_of_windows(windowed):
    result, _, cuts = windowed
    assert len(cuts) == 2
    for positions in (result.joint_position_world, np.where(result.take.visible[..., None], result.take.markers, 0.0)):
        step = np.linalg.norm(np.diff(positions, 2, axis=0), axis=-1).max(1)
        at_cuts = np.zeros(len(step), bool)
        for cut in cuts:
            at_cuts[cut - 3 : cut + 1] = True
        assert step[at_cuts].max() < 1.5 * np.percentile(step[~at_cuts], 99)


def test_the_files_of_a_take_in_windows_are_complete(cleaned, windowed):
    result, files, _ = windowed
    assert set(files) == OUTPUT_SUFFIXES
    copy = capture.read_take(files["c3d"])
    assert np.allclose(copy.markers, result.take.markers, atol=1e-5, equal_nan=True)
    kept = ~find_changed_samples(cleaned.result.input_take, cleaned.result.take)
    assert np.array_equal(copy.markers[kept], cleaned.result.input_take.markers[kept], equal_nan=True)
    motion = capture.read_capture(files["bvh"])
    assert motion.frame_count == copy.frame_count


def test_hands_of_a_take_in_windows_are_those_of_one_piece_also_where_a_window_shows_none(tmp_path, monkeypatch):
    take = windows.select_frames(compose_hands(0).take, slice(0, 700))
    fingers = [m for m, label in enumerate(take.labels) if label[1:4] in ("THM", "IDX", "MID", "RNG", "PNK")]
    take.markers[520:, fingers] = np.nan
    write_c3d(tmp_path / "hands.c3d", take)
    one = pipeline.clean(tmp_path / "hands.c3d")
    for name, value in (("OVERLAP_S", 0.5), ("MIN_SHOWN_S", 0.5), ("CUT_SEARCH_S", 0.2)):
        monkeypatch.setattr(windows, name, value)
    monkeypatch.setattr(capture, "MAX_PIECE_FRAMES", 300)
    monkeypatch.setattr(pipeline, "plan_windows", partial(windows.plan_windows, window_frames=150))
    many = pipeline.clean(tmp_path / "hands.c3d")
    notes = many.report.get("notes", [])
    assert any(note.startswith("Cleaned in") for note in notes)
    assert any("The fingers of the left hand" in note for note in notes)
    for before, after in zip(one.hands, many.hands, strict=True):
        assert before.hand.model.side == after.hand.model.side
        assert abs(before.hand.length_m - after.hand.length_m) < 0.01
        difference = np.linalg.norm(before.tip_positions - after.tip_positions, axis=-1)
        assert difference[:520].mean() < 0.005
        assert np.isfinite(difference).all()
        assert after.point_sd[620:, 15:].mean() > 2 * after.point_sd[:500, 15:].mean()
