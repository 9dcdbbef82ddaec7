from dataclasses import replace

import numpy as np
import pytest
from rerun.chunk import RrdReader

from mocapfix.errors import WriteError
from mocapfix.report import recording as comparison
from mocapfix.report.recording import CLEANED_COLOUR, ESTIMATED_COLOUR, FAULTY_COLOUR, INPUT_COLOUR, RELABELLED_COLOUR
from mocapfix.report.recording_view import FIELD_OF_VIEW_RAD, _compute_eye_position


class Recording:
    """What a .rrd holds: for each entity its columns, rows in the order of time, and its static values."""

    def __init__(self, path):
        reader = RrdReader(path)
        self.reader, self.static, self.rows = reader, {}, {}
        for chunk in reader.stream().to_chunks():
            batch = chunk.to_record_batch()
            columns = {name: batch.column(name) for name in batch.schema.names}
            values = {name: (c.cast("int64") if name == "time" else c).to_pylist() for name, c in columns.items()}  # nanoseconds
            if chunk.is_static:
                self.static.setdefault(chunk.entity_path, {}).update(values)
            else:
                for name, rows in values.items():
                    self.rows.setdefault(chunk.entity_path, {}).setdefault(name, []).extend(rows)

    def column(self, entity, end):
        return next(rows for name, rows in self.rows[entity].items() if name.endswith(end))


@pytest.fixture
def recording(scene, tmp_path):
    comparison(tmp_path / "walk.rrd", scene.comparison)
    return Recording(tmp_path / "walk.rrd")


def colour(text):
    return int(text[1:] + "ff", 16)


def test_markers_are_there_where_they_were_seen_and_nowhere_else(scene, recording):
    for entity, take in (("/world/before", scene.comparison.input_take), ("/world/after", scene.comparison.cleaned_take)):
        rows = recording.column(entity, "positions")
        for shown, markers, seen in zip(rows, take.log_markers, take.seen, strict=True):
            np.testing.assert_allclose(np.reshape(shown, (-1, 3)), markers[seen], atol=1e-6)


def test_a_frame_without_markers_is_a_row_without_points(recording):
    assert recording.column("/world/before", "positions")[200] == []
    assert recording.column("/world/after", "positions")[200] == []


def test_colours_say_what_was_faulty_and_what_was_mended(recording):
    before, after = recording.column("/world/before", "colors"), recording.column("/world/after", "colors")
    assert before[0] == [colour(INPUT_COLOUR)] * 30
    assert before[70].count(colour(FAULTY_COLOUR)) == 1
    assert after[70].count(colour(ESTIMATED_COLOUR)) == 2  # the gap's marker and the spike's
    assert after[0] == [colour(CLEANED_COLOUR)] * 30


def test_exchanged_labels_are_seen_before_and_after(scene, recording):
    ids, places = recording.column("/world/before", "class_ids"), recording.column("/world/before", "positions")
    shown = np.reshape(places[160], (-1, 3))[ids[160].index(10)]
    np.testing.assert_allclose(shown, scene.comparison.cleaned_take.log_markers[160, 11], atol=1e-6)
    assert recording.column("/world/before", "colors")[160].count(colour(RELABELLED_COLOUR)) == 2
    assert recording.column("/world/after", "colors")[160].count(colour(RELABELLED_COLOUR)) == 2
    assert recording.column("/state/M10", "state")[1] == ["relabelled"]


def test_what_had_no_name_is_there_under_its_own_and_as_taken_over(scene, recording):
    path = "/world/unlabelled"
    assert [len(row) for row in recording.column(path, "positions")] == [20 <= t < 40 for t in range(240)]
    assert (recording.column(path, "class_ids")[30], recording.column(path, "colors")[30]) == ([31], [colour(RELABELLED_COLOUR)])


def test_points_keep_their_markers_names(scene, recording):
    classes = recording.static["/world"]["AnnotationContext:context"][0][0]
    names = [each["class_description"]["info"]["label"] for each in classes]
    ids = recording.column("/world/before", "class_ids")
    assert tuple(names) == (*scene.comparison.input_take.labels, "*1<i>")
    assert ids[60] == [m for m in range(31) if scene.comparison.input_take.seen[60, m]]


def test_bones_join_each_joint_to_its_parent(scene, recording):
    strips = np.array(recording.column("/world/skeleton", "strips")[10])
    np.testing.assert_allclose(
        strips[:, 0], scene.comparison.joint_position_world[10, scene.comparison.skeleton.parents[1:]], atol=1e-6
    )
    np.testing.assert_allclose(strips[:, 1], scene.comparison.joint_position_world[10, 1:], atol=1e-6)


def test_time_is_in_seconds_and_frames_are_the_files(recording):
    assert recording.column("/world/before", "frame")[:2] == [101, 102]
    assert recording.column("/world/before", "time")[120] == 1_000_000_000


def test_the_states_of_a_marker_are_its_turns(recording):
    path = "/state/M03"
    assert recording.column(path, "state") == [["measured"], ["filled"], ["measured"], ["empty"], ["measured"]]
    assert recording.column(path, "frame") == [101, 151, 201, 301, 302]


def test_missing_markers_are_counted_before_and_after(scene, recording):
    for name, take in (("before", scene.comparison.input_take), ("after", scene.comparison.cleaned_take)):
        counts = np.ravel(recording.column(f"/missing/{name}", "scalars"))
        np.testing.assert_array_equal(counts, (~take.seen).sum(axis=1))


def test_errors_of_the_markers_farthest_off_are_in_millimetres(scene, recording):
    curves = [entity for entity in recording.rows if entity.startswith("/error/")]
    assert "/error/M07" in curves
    assert len(curves) <= 6
    np.testing.assert_allclose(np.ravel(recording.column("/error/M07", "scalars")), scene.comparison.residual_m[:, 7] * 1e3)


def test_a_take_without_a_body_has_no_skeleton_and_no_errors(scene, tmp_path):
    comparison(tmp_path / "walk.rrd", scene.with_(skeleton=None, joint_position_world=None, residual_m=None).comparison)
    entities = Recording(tmp_path / "walk.rrd").rows
    assert "/world/after" in entities
    assert not [entity for entity in entities if entity.startswith(("/world/skeleton", "/error"))]


def test_two_markers_of_one_name_have_lanes_of_their_own(scene, tmp_path):
    labels = tuple("M03" if m == 29 else label for m, label in enumerate(scene.comparison.input_take.labels))
    comparison(tmp_path / "walk.rrd", scene.with_(input_take=replace(scene.comparison.input_take, labels=labels)).comparison)
    lanes = [entity for entity in Recording(tmp_path / "walk.rrd").rows if entity.startswith("/state/M03")]
    assert len(lanes) == 2


def test_the_recording_brings_its_view(recording):
    assert len(recording.reader.blueprints()) == 1


def test_the_whole_body_is_in_the_picture_over_the_whole_take(scene):
    eye, target = _compute_eye_position(scene.comparison.joint_position_world)
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0, 1, 0]) / np.linalg.norm(np.cross(forward, [0, 1, 0]))
    seen = (scene.comparison.joint_position_world - eye).reshape(-1, 3) @ np.stack(
        [right, np.cross(right, forward), forward], axis=1
    )
    steepest = np.abs(seen[:, :2] / seen[:, 2:]).max()
    assert (seen[:, 2] > 0).all()
    assert 0.6 * np.tan(FIELD_OF_VIEW_RAD / 2) < steepest < np.tan(FIELD_OF_VIEW_RAD / 2)


def test_a_take_without_a_single_sample_can_be_shown(scene, tmp_path):
    nothing = scene.comparison.input_take.replace_markers(np.full_like(scene.comparison.input_take.log_markers, np.nan))
    none = {"before": nothing, "labelled": nothing, "after": nothing, "skeleton": None, "joints": None}
    comparison(tmp_path / "walk.rrd", scene.with_(**none, residual_m=np.full((240, 31), np.nan)).comparison)
    assert set(map(tuple, Recording(tmp_path / "walk.rrd").column("/world/before", "positions"))) == {()}


def test_a_folder_that_is_not_there_is_named(scene, tmp_path):
    with pytest.raises(WriteError, match=r"nowhere.*walk\.rrd"):
        comparison(tmp_path / "nowhere" / "walk.rrd", scene.comparison)
