from dataclasses import replace

import numpy as np
import pytest
from rerun.chunk import RrdReader

from mocapfix.errors import WriteError
from mocapfix.show import comparison
from mocapfix.show.comparison import AFTER, BEFORE, FAULTY, MENDED, OTHER
from mocapfix.show.view import FIELD, _eye


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
    comparison(tmp_path / "walk.rrd", scene.cleaning)
    return Recording(tmp_path / "walk.rrd")


def colour(text):
    return int(text[1:] + "ff", 16)


def test_markers_are_there_where_they_were_seen_and_nowhere_else(scene, recording):
    for entity, take in (("/world/before", scene.cleaning.before), ("/world/after", scene.cleaning.after)):
        rows = recording.column(entity, "positions")
        for shown, markers, seen in zip(rows, take.markers, take.seen, strict=True):
            np.testing.assert_allclose(np.reshape(shown, (-1, 3)), markers[seen], atol=1e-6)


def test_a_frame_without_markers_is_a_row_without_points(recording):
    assert recording.column("/world/before", "positions")[200] == []
    assert recording.column("/world/after", "positions")[200] == []


def test_colours_say_what_was_faulty_and_what_was_mended(recording):
    before, after = recording.column("/world/before", "colors"), recording.column("/world/after", "colors")
    assert before[0] == [colour(BEFORE)] * 30
    assert before[70].count(colour(FAULTY)) == 1
    assert after[70].count(colour(MENDED)) == 2  # the gap's marker and the spike's
    assert after[0] == [colour(AFTER)] * 30


def test_exchanged_labels_are_seen_before_and_after(scene, recording):
    ids, places = recording.column("/world/before", "class_ids"), recording.column("/world/before", "positions")
    shown = np.reshape(places[160], (-1, 3))[ids[160].index(10)]
    np.testing.assert_allclose(shown, scene.cleaning.after.markers[160, 11], atol=1e-6)
    assert recording.column("/world/before", "colors")[160].count(colour(OTHER)) == 2
    assert recording.column("/world/after", "colors")[160].count(colour(OTHER)) == 2
    assert recording.column("/state/M10", "state")[1] == ["relabelled"]


def test_what_had_no_name_is_there_under_its_own_and_as_taken_over(scene, recording):
    path = "/world/unlabelled"
    assert [len(row) for row in recording.column(path, "positions")] == [20 <= t < 40 for t in range(240)]
    assert (recording.column(path, "class_ids")[30], recording.column(path, "colors")[30]) == ([31], [colour(OTHER)])


def test_points_keep_their_markers_names(scene, recording):
    classes = recording.static["/world"]["AnnotationContext:context"][0][0]
    names = [each["class_description"]["info"]["label"] for each in classes]
    ids = recording.column("/world/before", "class_ids")
    assert tuple(names) == (*scene.cleaning.before.labels, "*1<i>")
    assert ids[60] == [m for m in range(31) if scene.cleaning.before.seen[60, m]]


def test_bones_join_each_joint_to_its_parent(scene, recording):
    strips = np.array(recording.column("/world/skeleton", "strips")[10])
    np.testing.assert_allclose(strips[:, 0], scene.cleaning.joints[10, scene.cleaning.skeleton.parents[1:]], atol=1e-6)
    np.testing.assert_allclose(strips[:, 1], scene.cleaning.joints[10, 1:], atol=1e-6)


def test_time_is_in_seconds_and_frames_are_the_files(recording):
    assert recording.column("/world/before", "frame")[:2] == [101, 102]
    assert recording.column("/world/before", "time")[120] == 1_000_000_000


def test_the_states_of_a_marker_are_its_turns(recording):
    path = "/state/M03"
    assert recording.column(path, "state") == [["measured"], ["filled"], ["measured"], ["empty"], ["measured"]]
    assert recording.column(path, "frame") == [101, 151, 201, 301, 302]


def test_missing_markers_are_counted_before_and_after(scene, recording):
    for name, take in (("before", scene.cleaning.before), ("after", scene.cleaning.after)):
        counts = np.ravel(recording.column(f"/missing/{name}", "scalars"))
        np.testing.assert_array_equal(counts, (~take.seen).sum(axis=1))


def test_errors_of_the_markers_farthest_off_are_in_millimetres(scene, recording):
    curves = [entity for entity in recording.rows if entity.startswith("/error/")]
    assert "/error/M07" in curves
    assert len(curves) <= 6
    np.testing.assert_allclose(np.ravel(recording.column("/error/M07", "scalars")), scene.cleaning.error[:, 7] * 1e3)


def test_a_take_without_a_body_has_no_skeleton_and_no_errors(scene, tmp_path):
    comparison(tmp_path / "walk.rrd", scene.with_(skeleton=None, joints=None, error=None).cleaning)
    entities = Recording(tmp_path / "walk.rrd").rows
    assert "/world/after" in entities
    assert not [entity for entity in entities if entity.startswith(("/world/skeleton", "/error"))]


def test_two_markers_of_one_name_have_lanes_of_their_own(scene, tmp_path):
    labels = tuple("M03" if m == 29 else label for m, label in enumerate(scene.cleaning.before.labels))
    comparison(tmp_path / "walk.rrd", scene.with_(before=replace(scene.cleaning.before, labels=labels)).cleaning)
    lanes = [entity for entity in Recording(tmp_path / "walk.rrd").rows if entity.startswith("/state/M03")]
    assert len(lanes) == 2


def test_the_recording_brings_its_view(recording):
    assert len(recording.reader.blueprints()) == 1


def test_the_whole_body_is_in_the_picture_over_the_whole_take(scene):
    eye, target = _eye(scene.cleaning.joints)
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0, 1, 0]) / np.linalg.norm(np.cross(forward, [0, 1, 0]))
    seen = (scene.cleaning.joints - eye).reshape(-1, 3) @ np.stack([right, np.cross(right, forward), forward], axis=1)
    steepest = np.abs(seen[:, :2] / seen[:, 2:]).max()
    assert (seen[:, 2] > 0).all()
    assert 0.6 * np.tan(FIELD / 2) < steepest < np.tan(FIELD / 2)


def test_a_take_without_a_single_sample_can_be_shown(scene, tmp_path):
    nothing = scene.cleaning.before.with_markers(np.full_like(scene.cleaning.before.markers, np.nan))
    none = {"before": nothing, "labelled": nothing, "after": nothing, "skeleton": None, "joints": None}
    comparison(tmp_path / "walk.rrd", scene.with_(**none, error=np.full((240, 31), np.nan)).cleaning)
    assert set(map(tuple, Recording(tmp_path / "walk.rrd").column("/world/before", "positions"))) == {()}


def test_a_folder_that_is_not_there_is_named(scene, tmp_path):
    with pytest.raises(WriteError, match=r"nowhere.*walk\.rrd"):
        comparison(tmp_path / "nowhere" / "walk.rrd", scene.cleaning)
