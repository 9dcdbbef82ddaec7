"""The whole way, on takes whose truth is known: what it mends and how well, what it leaves alone, what it writes."""

import hashlib
import json
import re
import warnings
from dataclasses import replace

import numpy as np
import pytest

from mocapfix import marker_sets, pipeline, synthetic, write
from mocapfix.bench.demo import compute_fill_errors
from mocapfix.calibrate import subject_file
from mocapfix.errors import SceneError, TakeError, WriteError
from mocapfix.options import CleanOptions, FillOptions
from mocapfix.read import capture
from mocapfix.report import review_file
from mocapfix.skeleton import load_cmu31_body
from mocapfix.solve import kinematics
from mocapfix.stats.sequences import find_runs
from tests.conftest import FIRST, as_c3d

KINDS = {"c3d", "bvh", "subject.yaml", "changes.yaml", "report.json", "report.html", "rrd"}


def long_gaps(truth):
    mask = np.zeros_like(truth.missing_mask)
    for m in range(mask.shape[1]):
        for first, last in find_runs(truth.missing_mask[:, m]):
            mask[first : last + 1, m] = (last - first + 1) / truth.rate >= 0.5
    return mask


def measured(truth, result):
    """-> the demo's table; no arm is lost in these takes"""
    with warnings.catch_warnings(action="ignore", category=RuntimeWarning):
        return compute_fill_errors(truth, result)


def bits(path):
    return hashlib.sha256(path.read_bytes()).hexdigest()


def lengths(skeleton):
    return np.linalg.norm(skeleton.offsets, axis=1)


@pytest.fixture(scope="module")
def known(brief):
    return subject_file.read_subject(brief.subject)


# how well


@pytest.mark.parametrize(
    ("damage", "against_linear", "against_cubic", "millimetres"),
    [("gaps under 0.5 s", 5, 3, 3), ("one marker lost for 0.5 s and more", 15, 15, 13), ("spikes", 60, 60, 2.5)],
)
def test_errors_fall_by_this_factor(cleaned, damage, against_linear, against_cubic, millimetres):
    error = {way: by_damage[damage] for way, by_damage in measured(cleaned.truth, cleaned.result).items()}
    assert error["mocapfix"] < error["linear"] / against_linear
    assert error["mocapfix"] < error["cubic"] / against_cubic
    assert error["mocapfix"] < millimetres


def test_everything_missing_is_filled_and_every_spike_found(cleaned):
    fill = cleaned.result.report["fill"]
    assert fill["missing_before"] == fill["filled"] == cleaned.truth.missing_mask.sum()
    assert (fill["left_empty"], fill["unfilled"]) == (0, [])
    believed = cleaned.result.faults.compute_inlier_mask(cleaned.result.input_take)
    np.testing.assert_array_equal(believed, ~cleaned.truth.missing_mask & ~cleaned.truth.moved)
    assert fill["replaced"] == cleaned.truth.moved.sum()


def test_samples_that_nothing_struck_are_returned_bit_for_bit(cleaned):
    sound = ~cleaned.truth.missing_mask & ~cleaned.truth.moved
    before, after = cleaned.result.input_take.markers[sound], cleaned.result.take.markers[sound]
    assert before.tobytes() == after.tobytes()
    assert np.isnan(cleaned.result.take.sample_sd[sound]).all()


def test_joints_are_near_the_true_ones_and_as_smooth(cleaned):
    joints, truth = cleaned.result.joints, cleaned.truth.joints
    assert np.linalg.norm(joints - truth, axis=-1).mean() < 0.016

    def jerk(path):
        return np.sqrt((np.diff(path, 3, axis=0) ** 2).mean())

    assert jerk(joints) < 2.5 * jerk(truth)


def test_the_subject_is_nearer_to_the_person_than_the_average_body(cleaned):
    found, person = cleaned.result.subject, cleaned.truth.subject
    nominal = marker_sets.load_marker_set("cmu41")

    def off(skeleton):
        return np.sqrt(((lengths(skeleton) - lengths(person.skeleton)) ** 2).mean())

    assert off(found.skeleton) < 0.75 * off(load_cmu31_body().skeleton)
    assert np.abs(lengths(found.skeleton) - lengths(person.skeleton)).max() < 0.022
    places = np.linalg.norm(found.places - person.places, axis=1).mean()
    assert places < 0.7 * np.linalg.norm(nominal.marker_offsets - person.places, axis=1).mean()


@pytest.mark.parametrize("lasting", ["short", "long"])
def test_predicted_deviations_are_honest(cleaned, lasting):
    where = long_gaps(cleaned.truth) if lasting == "long" else cleaned.truth.missing_mask & ~long_gaps(cleaned.truth)
    error = np.abs(cleaned.result.take.markers - cleaned.truth.markers)[where]
    deviation = cleaned.result.take.sample_sd[where][:, None]
    assert 0.45 < (error < deviation).mean() < 0.97  # 0.68 were it normal and exactly known
    assert (error < 2 * deviation).mean() > 0.9
    assert np.corrcoef(deviation[:, 0], error.mean(1))[0, 1] > 0.2  # where it says it is less sure, it errs more


def test_markers_are_as_far_from_the_body_as_the_report_says(cleaned):
    result = cleaned.result
    body = kinematics.compute_joint_and_marker_positions(result.subject, result.motion)[1]
    columns = marker_sets.load_marker_set("cmu41").find_columns(result.input_take.labels)
    believed = result.faults.compute_inlier_mask(result.input_take)[:, columns]
    distance = np.linalg.norm(result.input_take.markers[:, columns] - body, axis=-1)[believed]
    said = result.report["solve"]["marker_residual_mm"]
    assert said["mean"] == pytest.approx(distance.mean() * 1e3, abs=1e-3)
    assert said["p95"] == pytest.approx(np.percentile(distance, 95) * 1e3, abs=1e-3)
    assert said["mean"] < 6.0


# what is written


def test_all_files_are_written_and_the_two_motions_read_back(cleaned):
    assert set(cleaned.outputs) == KINDS
    assert {path.name for path in cleaned.outputs["c3d"].parent.iterdir()} == {f"somebody.{kind}" for kind in KINDS}
    back = capture.read_capture(cleaned.outputs["c3d"])
    np.testing.assert_allclose(back.markers, cleaned.result.take.markers, atol=1e-6)
    assert (back.labels, back.rate, back.first_frame) == (cleaned.truth.labels, cleaned.truth.rate, 1)
    text = cleaned.outputs["bvh"].read_text(encoding="ascii")
    rows = np.array([line.split() for line in text.split("Frame Time:")[1].splitlines()[1:]], float)
    assert f"Frames: {cleaned.result.input_take.frames}\nFrame Time: 0.00833333" in text
    np.testing.assert_allclose(rows[:, :3] / 100, cleaned.result.motion.root, atol=1e-7)
    turns = np.abs(np.diff(rows[:, 3:], axis=0))
    assert turns.max() < 90


def test_the_files_are_named_by_the_stem_and_the_input_stays(brief, known, tmp_path):
    source = tmp_path / "a.b.c3d"
    source.write_bytes(brief.path.read_bytes())
    was = bits(source)
    result = pipeline.clean(source, subject=known)
    outputs = result.write(tmp_path / "deep" / "out")
    assert {kind: path.name for kind, path in outputs.items()} == {kind: f"a.b.{kind}" for kind in KINDS}
    assert all(path.stat().st_size > 0 for path in outputs.values())
    assert bits(source) == was
    with pytest.raises(WriteError, match=r"would replace the input file"):
        result.write(tmp_path, overwrite=True)
    assert bits(source) == was
    assert {path.name for path in tmp_path.iterdir()} == {"a.b.c3d", "deep"}


def test_an_output_that_is_there_stops_all_of_them(brief, known, tmp_path):
    result = pipeline.clean(brief.path, subject=known)
    mine = tmp_path / "brief.bvh"
    mine.write_text("mine")
    with pytest.raises(WriteError, match=r"brief\.bvh: already exists; give --overwrite"):
        result.write(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["brief.bvh"]
    assert mine.read_text() == "mine"
    result.write(tmp_path, overwrite=True)
    assert mine.read_text().startswith("HIERARCHY")


def test_the_written_report_is_the_results_and_plain_json(cleaned):
    def refuse(constant):
        raise AssertionError(f"{constant} is no JSON")

    written = json.loads(cleaned.outputs["report.json"].read_text(encoding="utf-8"), parse_constant=refuse)
    kept = json.loads(json.dumps(cleaned.result.report))
    assert {**written, "seconds": None} == {**kept, "seconds": None}
    assert not {"write", "show"} & set(kept["seconds"])  # writing leaves the result as it is
    assert list(written) == ["take", "faults", "changes", "subject", "solve", "fill", "seconds", "notes"]
    assert {"read", "calibrate", "solve", "fill", "write", "show"} <= set(written["seconds"])
    assert written["seconds"]["total"] == pytest.approx(sum(v for k, v in written["seconds"].items() if k != "total"), abs=1e-3)


def test_faults_and_gaps_left_carry_the_files_own_frame_numbers(brief, known):
    report = pipeline.clean(brief.path, subject=known, max_gap_s=0.1).report
    assert report["take"]["first_frame"] == FIRST
    faults = {(each["kind"], each["marker"], each["first"], each["last"]) for each in report["faults"]}
    assert {("gap", "RELB", 341, 360), ("gap", "LKNE", 371, 390), ("spike", "STRN", 321, 321)} <= faults
    left = {(each["marker"], each["first"], each["last"], each["reason"]) for each in report["fill"]["unfilled"]}
    reason = "the gap is longer than 0.1 s"
    assert left == {("RELB", 341, 360, reason), ("LKNE", 371, 390, reason)}


# nothing else, and not again


def test_cleaning_an_output_again_changes_nothing(muddled, tmp_path):
    result = pipeline.clean(muddled.output, subject=muddled.subject)
    assert result.changes == ()
    assert write.patch_c3d(tmp_path / "again.c3d", result.input_take, result.take) == []
    assert (tmp_path / "again.c3d").read_bytes() == muddled.output.read_bytes()


def test_a_sound_take_comes_back_byte_by_byte(cleaned, tmp_path):
    sound = tmp_path / "sound.c3d"
    sound.write_bytes(as_c3d(cleaned.truth.markers[200:440], cleaned.truth.labels))
    result = pipeline.clean(sound)
    assert (result.faults.items, result.changes, result.unfilled_runs) == ((), (), ())
    assert write.patch_c3d(tmp_path / "again.c3d", result.input_take, result.take) == []
    assert (tmp_path / "again.c3d").read_bytes() == sound.read_bytes()


def test_whatever_differs_lies_in_the_intervals_of_the_record(cleaned):
    before, after = (capture.read_capture(path) for path in (cleaned.path, cleaned.outputs["c3d"]))
    of = {label: m for m, label in enumerate(before.labels)}
    told = np.zeros(before.visible.shape, int)
    for change in cleaned.result.report["changes"]:
        frames = slice(change["first"] - before.first_frame, change["last"] - before.first_frame + 1)
        told[frames, [of[label] for label in change["markers"]]] += 1
        assert change["samples"] == (change["last"] - change["first"] + 1) * len(change["markers"])
    differs = ~((before.markers == after.markers) | np.isnan(before.markers) & np.isnan(after.markers)).all(-1)
    np.testing.assert_array_equal(told, differs)


# a marker that is knocked


KNOCK, SHIFT = 240, (0.0, -0.04, 0.0)  # frame and metres, in the thorax's axes


@pytest.fixture(scope="module")
def knocked(tmp_path_factory):
    """-> T10 is knocked 40 mm down in the middle of 8 s, hidden meanwhile, and once before and once after: path and truth"""
    truth = synthetic.compose_take(seed=3, seconds=8.0, rate=60.0)
    path, marker = tmp_path_factory.mktemp("knocked") / "knocked.c3d", truth.labels.index("T10")
    where, rotation = truth.marker_positions.copy(), kinematics.compute_world_poses(truth.subject.skeleton, truth.motion)[1]
    where[KNOCK:, marker] += rotation[KNOCK:, truth.subject.joints[marker]] @ np.array(SHIFT)
    seen = where.copy()
    for first, last in HIDDEN:
        seen[first : last + 1, marker] = np.nan
    path.write_bytes(as_c3d(seen, truth.labels, rate=60.0))
    return path, truth, where


HIDDEN = ((100, 119), (KNOCK - 6, KNOCK + 5), (330, 349))


def cleaned_without(knocked, **asked):
    path, truth, where = knocked
    result = pipeline.clean(path, subject=truth.subject, **asked)
    m = truth.labels.index("T10")
    hidden = np.zeros(len(where), bool)
    for first, last in HIDDEN:
        hidden[first : last + 1] = True
    np.testing.assert_array_equal(result.take.markers[~hidden], result.input_take.markers[~hidden])
    return result, np.linalg.norm(result.take.markers[:, m] - where[:, m], axis=-1)


def test_a_knocked_marker_is_found_and_its_gaps_are_filled_at_either_place(knocked):
    result, off = cleaned_without(knocked)
    said = {change.kind: change for change in result.changes}
    assert abs(said["moved"].first - 1 - KNOCK) <= 6
    assert (said["moved"].markers, said["moved"].last, said["moved"].samples) == (("T10",), 480, 0)
    for first, last in (HIDDEN[0], HIDDEN[2]):
        assert off[first : last + 1].max() < 0.01
    assert result.unfilled_runs == ()
    assert np.linalg.norm(result.joint_position_world - knocked[1].joints, axis=-1).mean() < 0.006


def test_max_gap_is_held_against_the_gap_and_not_what_is_hidden_of_a_place(knocked):
    result, off = cleaned_without(knocked, max_gap_s=0.25)
    first, last = HIDDEN[1]
    assert not np.isnan(off[first : last + 1]).any()
    assert [(each.first, each.last, each.reason) for each in result.unfilled_runs] == [
        (first, last, "the gap is longer than 0.25 s") for first, last in (HIDDEN[0], HIDDEN[2])
    ]
    left = [(each.first, each.last) for each in cleaned_without(knocked, max_gap_s=0.15)[0].unfilled_runs]
    assert left == list(HIDDEN)


def test_a_move_that_is_rejected_is_none(knocked, tmp_path):
    result, _ = cleaned_without(knocked)
    path = tmp_path / "decided.yaml"
    decided = [replace(each, decision="reject" if each.kind == "moved" else "accept") for each in result.changes]
    review_file.write_review_file(path, result.input_take, decided)
    result, _ = cleaned_without(knocked, review_files=path)
    assert not result.faults.select_kinds("moved", "drift")
    assert {change.kind: change.decision for change in result.changes} == {"gap": "accept", "moved": "reject"}


# what may be touched


def changed(result):
    """-> {label: file frame numbers of the samples that differ}"""
    before, after = result.input_take.markers, result.take.markers
    differs = ~((before == after) | np.isnan(before) & np.isnan(after)).all(-1)
    return {result.input_take.labels[m]: (np.flatnonzero(differs[:, m]) + FIRST).tolist() for m in np.flatnonzero(differs.any(0))}


RELB, LKNE, STRN = list(range(341, 361)), list(range(371, 391)), [321]


@pytest.mark.parametrize(
    ("options", "touched"),
    [
        (FillOptions(), {"RELB": RELB, "LKNE": LKNE, "STRN": STRN}),
        (FillOptions(keep=("RELB", "STRN")), {"LKNE": LKNE}),
        (FillOptions(frames=(350, 380)), {"RELB": RELB[9:], "LKNE": LKNE[:10]}),
        (FillOptions(frames=(-(2**62), 340)), {"STRN": STRN}),
        (FillOptions(frames=(321, 321), keep=("STRN",)), {}),
        (FillOptions(max_gap_s=0.1), {"STRN": STRN}),
        (FillOptions(max_gap_s=20 / 120), {"RELB": RELB, "LKNE": LKNE, "STRN": STRN}),
    ],
    ids=["all", "keep", "frames", "until", "keep in frames", "max-gap", "max-gap, exactly"],
)
def test_options_say_what_is_touched_and_nothing_else_is(brief, known, options, touched):
    result = pipeline.clean(brief.path, subject=known, options=CleanOptions(fill=options))
    assert changed(result) == touched
    fill = result.report["fill"]
    assert fill["filled"] == sum(len(touched.get(label, ())) for label in ("RELB", "LKNE"))
    assert fill["replaced"] == len(touched.get("STRN", ()))
    assert fill["left_empty"] == fill["missing_before"] - fill["filled"]
    assert sum(each["last"] - each["first"] + 1 for each in fill["unfilled"]) == fill["left_empty"]


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (FillOptions(keep=("RELB", "NOSE")), "brief.c3d: has no marker NOSE to keep; its markers are "),
        (FillOptions(frames=(1, 300)), "brief.c3d: frames 1 to 300 are not in the take, which has 301 to 420."),
        (FillOptions(frames=(421, 500)), "brief.c3d: frames 421 to 500 are not in the take, which has 301 to 420."),
        (FillOptions(frames=(350, 340)), "brief.c3d: frames 350 to 340: the first must not come after the last."),
    ],
)
def test_what_the_take_does_not_have_cannot_be_named(brief, options, sentence):
    with pytest.raises(TakeError, match=re.escape(sentence)):
        pipeline.clean(brief.path, options=CleanOptions(fill=options))


# other people, other markers


def test_a_known_subject_keeps_its_bones_and_is_not_calibrated(cleaned, brief, known):
    result = pipeline.clean(brief.path, subject=brief.subject)
    assert result.subject is not None
    np.testing.assert_array_equal(result.subject.skeleton.offsets, known.skeleton.offsets)
    np.testing.assert_allclose(result.subject.skeleton.offsets, cleaned.result.subject.skeleton.offsets, atol=1e-7)
    np.testing.assert_array_equal(result.subject.marker_offsets, known.places)
    assert "calibrate" not in result.report["seconds"]
    assert result.report["take"]["marker_set"] == "cmu41"


def test_an_arm_whose_markers_all_tremble_is_not_lost(tmp_path):
    truth, path = synthetic.compose_take(seed=3, seconds=4.0), tmp_path / "trembling.c3d"
    arm, shaken = [truth.labels.index(f"L{name}") for name in ("FRM", "WRA", "WRB", "FIN")], truth.marker_positions.copy()
    shaken[120:360, arm] += np.random.default_rng(0).normal(0, 0.02, (240, 4, 3))
    nothing = np.zeros_like(truth.missing_mask)
    synthetic.write_synthetic_take(path, replace(truth, missing_mask=nothing, damaged_positions=shaken, spike_mask=nothing))
    result = pipeline.clean(path, subject=truth.subject)
    assert [fault.kind for fault in result.faults.items] == ["jitter"] * 4
    hand = truth.subject.skeleton.find_joint("LeftHand")
    assert result.joint_position_world is not None
    assert (
        np.linalg.norm(result.joint_position_world[120:360, hand] - truth.joint_positions[120:360, hand], axis=1).mean() < 0.015
    )  # lost: 0.025
    mended = (result.take.markers != result.input_take.markers).any(axis=2)
    assert mended[120:360, arm].mean() > 0.9


def test_two_takes_of_a_person_are_calibrated_together(cleaned, brief):
    subject = pipeline.calibrate_takes([brief.path, cleaned.path])
    assert subject.labels == marker_sets.load_marker_set("cmu41").labels
    assert np.abs(lengths(subject.skeleton) - lengths(cleaned.truth.subject.skeleton)).max() < 0.025


def test_a_take_that_no_set_fits_is_cleaned_without_a_body(cleaned, brief, tmp_path):
    source = tmp_path / "prop.c3d"
    names = [f"P{n + 1}" for n in range(41)]
    source.write_bytes(as_c3d(cleaned.truth.damaged, names))
    result = pipeline.clean(source)
    assert (result.subject, result.motion, result.joint_position_world, result.residual_m) == (None, None, None, None)
    assert (result.report["take"]["marker_set"], result.report["subject"], result.report["solve"]) == (None, None, None)
    first, second = result.report["notes"]
    assert first.startswith("No marker set fits the labels P1, P2, P3,")
    assert "none of them is in any set (cmu41, frontwaist53, helen-hayes, " in first
    assert second == "The take was cleaned without a skeleton: there is no BVH."
    outputs = result.write(tmp_path / "out")
    assert set(outputs) == KINDS - {"bvh", "subject.yaml"}
    assert {path.name for path in (tmp_path / "out").iterdir()} == {f"prop.{kind}" for kind in outputs}
    error = measured(cleaned.truth, result)
    assert error["mocapfix"]["gaps under 0.5 s"] < error["cubic"]["gaps under 0.5 s"] / 2
    assert error["mocapfix"]["one marker lost for 0.5 s and more"] < error["linear"]["one marker lost for 0.5 s and more"] / 4
    sound = ~cleaned.truth.missing_mask & ~cleaned.truth.moved
    assert result.input_take.markers[sound].tobytes() == result.take.markers[sound].tobytes()


def test_legs_alone_are_cleaned_without_a_body(cleaned, tmp_path):
    leg = ("FWT", "BWT", "THI", "KNE", "SHN", "ANK", "HEE", "TOE")
    legs = [n for n, label in enumerate(cleaned.truth.labels) if label[1:] in leg]
    source = tmp_path / "legs.c3d"
    source.write_bytes(as_c3d(cleaned.truth.damaged[:, legs], [cleaned.truth.labels[n] for n in legs]))
    result = pipeline.clean(source)
    assert result.subject is None
    first, second = result.report["notes"]
    assert re.search(r"the nearest is cmu41 with \d+ of its 41 markers, but the .*thorax.* cannot be located; not found: ", first)
    assert second == "The take was cleaned without a skeleton: there is no BVH."
    fill = result.report["fill"]
    assert fill["filled"] > 0.8 * fill["missing_before"] > 0
    assert sum(each["last"] - each["first"] + 1 for each in fill["unfilled"]) == fill["left_empty"]
    assert all(each["reason"] for each in fill["unfilled"])


def test_a_set_that_was_named_must_fit(brief):
    with pytest.raises(TakeError, match=r"^brief\.c3d: plug-in-gait39 does not fit: \d+ of its \d+ markers, .*not found: "):
        pipeline.clean(brief.path, marker_set="plug-in-gait39")


def test_labels_exchanged_throughout_are_put_right_and_where_they_are_kept_the_markers_are_named(brief, known, tmp_path):
    labels = list(brief.labels)
    a, b = labels.index("LKNE"), labels.index("RSHO")
    labels[a], labels[b] = labels[b], labels[a]
    source, path = tmp_path / "swapped.c3d", tmp_path / "decided.yaml"
    source.write_bytes(as_c3d(brief.markers, labels))
    result = pipeline.clean(source, subject=known)
    said = {change.kind: change for change in result.changes}["mislabelled"]
    assert (set(said.markers), said.first, said.last) == ({"LKNE", "RSHO"}, 1, 120)
    seen = ~np.isnan(brief.markers[:, a, 0])
    np.testing.assert_allclose(result.take.markers[seen, b], brief.markers[seen, a], atol=1e-6)
    assert result.report["notes"] == []
    review_file.write_review_file(path, result.input_take, [replace(said, decision="keep")])
    notes = " ".join(pipeline.clean(source, subject=known, review_files=path).report["notes"])
    for label in ("LKNE", "RSHO"):
        assert f"{label} is more than 60 mm from the body in most of its frames; check its label." in notes


def test_stages_are_told_in_order(brief):
    told = []
    pipeline.clean(brief.path, progress=told.append)
    assert told == ["read", "detect", "calibrate", "initialise", "solve", "detect", "fill"]


def test_a_start_that_there_is_not_is_refused_before_anything_is_read():
    with pytest.raises(SceneError, match=r"no start 'hybrik'; choose one of: .*registration, previous"):
        pipeline.clean("nowhere.c3d", method="hybrik")


def test_the_start_that_was_chosen_is_gone_from_and_told(brief):
    results = {init: pipeline.clean(brief.path, subject=brief.subject, method=init) for init in ("registration", "previous")}
    motions = {init: result.motion for init, result in results.items()}
    for init, result in results.items():
        assert result.report["solve"]["start"] == init
    assert motions["previous"]
    assert motions["registration"]
    assert motions["previous"].iterations.mean() < motions["registration"].iterations.mean() - 1
    joints = [result.joint_position_world for result in results.values()]
    assert joints[0] is not None
    assert joints[1] is not None
    np.testing.assert_allclose(joints[1], joints[0], atol=2e-3)


@pytest.mark.parametrize("scale", [0.0, -1.0, float("nan"), float("inf")])
def test_a_prior_that_cannot_be_believed_so_is_refused_before_anything_is_read(scale):
    with pytest.raises(SceneError, match="scale must be more than 0 and finite"):
        pipeline.clean("nowhere.c3d", prior_scale=scale)
