from dataclasses import replace

import numpy as np
import pytest
import rerun as rr
from hypothesis import example, given
from hypothesis import strategies as st
from rerun.chunk import RrdReader

from mocapfix.characters.character import CharacterMotion
from mocapfix.characters.character_files import write_character_glb
from mocapfix.characters.load_character import load_character
from mocapfix.errors import WriteError
from mocapfix.report.contact_sheet import ShownFigure
from mocapfix.report.recording import (
    BESIDE_M,
    CLEANED_COLOUR,
    ESTIMATED_COLOUR,
    FAULTY_COLOUR,
    FIELD_OF_VIEW_RAD,
    INPUT_COLOUR,
    MOMENT_TIMELINE,
    RELABELLED_COLOUR,
    _compute_eye_position,
    name_entities,
    write_recording,
)


class Recording:
    """Contents of a .rrd file: the columns of each entity with rows in the order of time, and its static values."""

    def __init__(self, path):
        reader = RrdReader(path)
        self.reader, self.static, self.rows, self.moment = reader, {}, {}, {}
        durations = ("time", MOMENT_TIMELINE)
        for chunk in reader.stream().to_chunks():
            batch = chunk.to_record_batch()
            columns = {name: batch.column(name) for name in batch.schema.names}
            in_ns = {name: c.cast("int64") if name in durations else c for name, c in columns.items()}
            values = {name: column.to_pylist() for name, column in in_ns.items()}
            if chunk.is_static:
                self.static.setdefault(chunk.entity_path, {}).update(values)
            else:
                columns_of = self.moment if MOMENT_TIMELINE in values else self.rows
                for name, rows in values.items():
                    columns_of.setdefault(chunk.entity_path, {}).setdefault(name, []).extend(rows)

    def read_column(self, entity, end):
        """Return the rows of the column whose name ends with `end`."""
        return next(rows for name, rows in self.rows[entity].items() if name.endswith(end))


@pytest.fixture
def recording(scene, tmp_path):
    write_recording(tmp_path / "walk.rrd", scene.comparison)
    return Recording(tmp_path / "walk.rrd")


def parse_colour(text):
    return int(text[1:] + "ff", 16)


def test_visible_markers_are_shown_at_their_positions(scene, recording):
    takes = (("/world/before", scene.comparison.input_take), ("/world/after", scene.comparison.cleaned_take))
    for entity, take in takes:
        rows = recording.read_column(entity, "positions")
        for positions, markers, visible in zip(rows, take.markers, take.visible, strict=True):
            np.testing.assert_allclose(np.reshape(positions, (-1, 3)), markers[visible], atol=1e-6)


def test_a_frame_without_markers_is_a_row_without_points(recording):
    assert recording.read_column("/world/before", "positions")[200] == []
    assert recording.read_column("/world/after", "positions")[200] == []


def test_faulty_and_estimated_markers_are_coloured(recording):
    before, after = recording.read_column("/world/before", "colors"), recording.read_column("/world/after", "colors")
    assert before[0] == [parse_colour(INPUT_COLOUR)] * 30
    assert before[70].count(parse_colour(FAULTY_COLOUR)) == 1
    assert after[70].count(parse_colour(ESTIMATED_COLOUR)) == 2  # the markers of the gap and of the spike
    assert after[0] == [parse_colour(CLEANED_COLOUR)] * 30


def test_swapped_labels_are_shown_before_and_after(scene, recording):
    ids, positions = recording.read_column("/world/before", "class_ids"), recording.read_column("/world/before", "positions")
    position = np.reshape(positions[160], (-1, 3))[ids[160].index(10)]
    np.testing.assert_allclose(position, scene.comparison.cleaned_take.markers[160, 11], atol=1e-6)
    assert recording.read_column("/world/before", "colors")[160].count(parse_colour(RELABELLED_COLOUR)) == 2
    assert recording.read_column("/world/after", "colors")[160].count(parse_colour(RELABELLED_COLOUR)) == 2
    assert recording.read_column("/state/M10", "state")[1] == ["relabelled"]


def test_joined_unlabelled_trajectory_is_shown_as_relabelled(recording):
    path = "/world/unlabelled"
    assert [len(row) for row in recording.read_column(path, "positions")] == [20 <= t < 40 for t in range(240)]
    assert recording.read_column(path, "class_ids")[30] == [31]
    assert recording.read_column(path, "colors")[30] == [parse_colour(RELABELLED_COLOUR)]


def test_points_have_the_labels_of_their_markers(scene, recording):
    classes = recording.static["/world"]["AnnotationContext:context"][0][0]
    names = [each["class_description"]["info"]["label"] for each in classes]
    ids = recording.read_column("/world/before", "class_ids")
    assert tuple(names) == (*scene.comparison.input_take.labels, "*1<i>")
    assert ids[60] == [m for m in range(31) if scene.comparison.input_take.visible[60, m]]


def test_bones_join_each_joint_to_its_parent(scene, recording):
    strips = np.array(recording.read_column("/world/skeleton", "strips")[10])
    joints, parents = scene.comparison.joint_position_world[10], scene.comparison.skeleton.parents
    np.testing.assert_allclose(strips[:, 0], joints[parents[1:]], atol=1e-6)
    np.testing.assert_allclose(strips[:, 1], joints[1:], atol=1e-6)


def test_a_figure_is_as_large_as_the_body_and_stands_beside_it(scene, tmp_path):
    """The figure has half of its size, and its floor is at 0; it has frames from 0.5 s on."""
    character, glb, take = load_character("mixamo"), tmp_path / "walk.mixamo.glb", scene.comparison.input_take
    rest = character.skeleton.rest_rotations
    place = np.array([0.0, 1.0, 0.0]) + np.arange(20)[:, None] * [0.0, 0.0, 0.01]
    write_character_glb(glb, character, CharacterMotion(place, np.tile(rest, (20, 1, 1, 1)), take.rate), "walk")
    write_recording(tmp_path / "walk.rrd", scene.comparison, [ShownFigure(character, glb, 2.0, 0.5, 0.5 + 19 / take.rate, 0.1)])
    recorded = Recording(tmp_path / "walk.rrd")
    strips, first = recorded.read_column("/world/figures/mixamo", "strips"), round(0.5 * take.rate)
    shown = {n for n, lines in enumerate(strips) if lines}
    assert {*range(first, first + 20)} <= shown <= {*range(first - 6, first + 26)}  # it stays for 0.05 s
    np.testing.assert_allclose(strips[first + 10][0][0], np.array([0.0, 2.0 + 0.1, 2 * 0.1]) + BESIDE_M, atol=1e-5)


def test_times_are_seconds_and_frames_are_the_files_numbers(recording):
    assert recording.read_column("/world/before", "frame")[:2] == [101, 102]
    assert recording.read_column("/world/before", "time")[120] == 1_000_000_000


def test_states_are_logged_where_they_change(recording):
    path = "/state/M03"
    assert recording.read_column(path, "state") == [["measured"], ["filled"], ["measured"], ["empty"], ["measured"]]
    assert recording.read_column(path, "frame") == [101, 151, 201, 301, 302]


def test_missing_markers_are_counted_before_and_after(scene, recording):
    for name, take in (("before", scene.comparison.input_take), ("after", scene.comparison.cleaned_take)):
        counts = np.ravel(recording.read_column(f"/missing/{name}", "scalars"))
        np.testing.assert_array_equal(counts, (~take.visible).sum(axis=1))


def test_largest_residuals_are_logged_in_millimetres(scene, recording):
    curves = [entity for entity in recording.rows if entity.startswith("/error/")]
    assert "/error/M07" in curves
    assert len(curves) <= 6
    residual_mm = np.ravel(recording.read_column("/error/M07", "scalars"))
    np.testing.assert_allclose(residual_mm, scene.comparison.residual_m[:, 7] * 1e3)


def test_a_take_without_a_body_has_neither_skeleton_nor_residuals(scene, tmp_path):
    without_body = scene.replace_comparison(skeleton=None, joint_position_world=None, residual_m=None)
    write_recording(tmp_path / "walk.rrd", without_body.comparison)
    entities = Recording(tmp_path / "walk.rrd").rows
    assert "/world/after" in entities
    assert not [entity for entity in entities if entity.startswith(("/world/skeleton", "/error"))]


def test_equal_labels_have_separate_lanes(scene, tmp_path):
    labels = tuple("M03" if m == 29 else label for m, label in enumerate(scene.comparison.input_take.labels))
    input_take = replace(scene.comparison.input_take, labels=labels)
    write_recording(tmp_path / "walk.rrd", scene.replace_comparison(input_take=input_take).comparison)
    lanes = [entity for entity in Recording(tmp_path / "walk.rrd").rows if entity.startswith("/state/M03")]
    assert len(lanes) == 2


def test_the_recording_opens_at_the_worst_moment_with_the_body_in_view(scene, recording):
    frame, _ = scene.comparison.worst_moment
    first, last = 0, frame + 120  # a second at 120 Hz
    time_ns = recording.moment["/world/after"][MOMENT_TIMELINE]
    np.testing.assert_allclose(time_ns, 1e9 * np.arange(first, last + 1) / 120, atol=1)
    whole = recording.read_column("/world/after", "positions")
    shown = next(rows for name, rows in recording.moment["/world/after"].items() if name.endswith("positions"))
    assert shown == whole[first : last + 1]
    assert recording.moment.keys() == recording.rows.keys()  # no view is empty
    for entity in recording.moment:
        if entity.startswith("/state/"):  # each lane begins with its state
            assert recording.moment[entity][MOMENT_TIMELINE][0] == 0
    (blueprint,) = recording.reader.blueprints()
    chunks = [chunk for chunk in recording.reader.stream(store=blueprint).to_chunks() if chunk.entity_path == "/time_panel"]
    panel = [chunk.to_record_batch() for chunk in chunks]
    values = {name.rpartition(":")[2]: each.column(name)[0] for each in panel for name in each.schema.names if ":" in name}
    assert values["timeline"].as_py() == [MOMENT_TIMELINE]


@given(st.lists(st.text(max_size=12), max_size=8))
@example(["subject:LANK", "subject:LANK", "subject/LANK", "*1<i>", "", ":", "A-2", "A", "A", "__x"])
def test_entities_have_names_that_need_no_escape(labels):
    paths = name_entities(labels)
    assert len(set(paths)) == len(paths) == len(labels)
    for path in paths:
        assert rr.new_entity_path(path.split("/")) == f"/{path}"
        assert not any(part.startswith("__") for part in path.split("/"))


def test_a_subject_is_a_part_of_the_path():
    assert name_entities(["Jim:LANK", "LANK", "LANK"]) == ["Jim/LANK", "LANK", "LANK-2"]


def test_the_whole_body_is_in_view_over_the_whole_take(scene):
    joints = scene.comparison.joint_position_world
    eye, target = _compute_eye_position(joints)
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0, 1, 0]) / np.linalg.norm(np.cross(forward, [0, 1, 0]))
    position_eye = (joints - eye).reshape(-1, 3) @ np.stack([right, np.cross(right, forward), forward], axis=1)
    steepest = np.abs(position_eye[:, :2] / position_eye[:, 2:]).max()
    assert (position_eye[:, 2] > 0).all()
    assert 0.6 * np.tan(FIELD_OF_VIEW_RAD / 2) < steepest < np.tan(FIELD_OF_VIEW_RAD / 2)


def test_a_take_without_any_sample_can_be_recorded(scene, tmp_path):
    empty = scene.comparison.input_take.replace_markers(np.full_like(scene.comparison.input_take.markers, np.nan))
    takes = {"input_take": empty, "relabelled_take": empty, "cleaned_take": empty}
    body = {"skeleton": None, "joint_position_world": None, "residual_m": np.full((240, 31), np.nan)}
    write_recording(tmp_path / "walk.rrd", scene.replace_comparison(**takes, **body).comparison)
    assert set(map(tuple, Recording(tmp_path / "walk.rrd").read_column("/world/before", "positions"))) == {()}


def test_a_missing_folder_is_named(scene, tmp_path):
    with pytest.raises(WriteError, match=r"nowhere.*walk\.rrd"):
        write_recording(tmp_path / "nowhere" / "walk.rrd", scene.comparison)
