from pathlib import Path

import numpy as np
import pytest

from mocapfix.io import capture
from mocapfix.io.points import detect_computed_samples, detect_uncaptured_samples, find_named_computed_points
from tests.c3d_files import c3d_bytes
from tests.captures import CAPTURES, needs_captures
from tests.stats.test_point_functions import build_segment, compute_hip_centre

CAMERAS = 7 << 8


def test_computed_samples_have_a_residual_and_no_cameras():
    visible = np.ones((2, 4), bool)
    visible[1, 3] = False
    words = np.array([[CAMERAS + 3, 0, 5, CAMERAS], [0, 0.5, 255, 7]])
    np.testing.assert_array_equal(
        detect_computed_samples(words, visible), [[False, False, True, False], [False, False, True, False]]
    )


def test_samples_are_measured_in_a_file_without_cameras():
    words = np.array([[1.0, 2, 3, 0, -1]])
    assert not detect_computed_samples(words, words >= 0).any()


def test_uncaptured_samples_are_detected_if_the_file_records_cameras():
    words = np.full((10, 10), float(CAMERAS))
    words[3:6, 2] = 0
    words[6, 2] = 4
    words[7, 2] = -1
    found = np.argwhere(detect_uncaptured_samples(words, words >= 0))
    np.testing.assert_array_equal(found, [[3, 2], [4, 2], [5, 2], [6, 2]])
    words[:, :2] = 0
    assert not detect_uncaptured_samples(words, words >= 0).any()


COMPUTED_NAMES = [
    *("LHJC", "RHJC", "Jim:LKJC", "R_AJC", "V_L.KJC", "MidHJC", "HJC_L", "LeftHipCenter", "RightHipCentreStatic", "CoM"),
    *("L.KneeJointCenter", "CentreOfMass", "Pelvis_COG", "Jim:CentreOfMassFloor", "LASI_virtual", "Virtual Sacrum"),
]
MARKER_NAMES = [
    *("LASI", "LHIP", "L.Hip", "V.Sacral", "WaistCBack", "LHEE", "JCT", "COMB", "LTIO1", "LFOX", "RTOO2", "Center", "LTIP"),
    *("HeadCenterFront", "WheelchairL:Marker1", "RLFC", "L.Knee.Medial"),
]


def read_points(folder: Path, points_m: np.ndarray, labels, words=None, **extra):
    path = folder / "take.c3d"
    path.write_bytes(c3d_bytes(points_m * 1000, labels, words, extra={"POINT:Y_SCREEN": "+Y", **extra}))
    return capture.read_take(path)


def test_computed_points_are_recognised_by_name():
    labels = [*COMPUTED_NAMES, *MARKER_NAMES]
    found = find_named_computed_points(labels, (), frozenset())
    assert [label for label, is_found in zip(labels, found, strict=True) if is_found] == COMPUTED_NAMES


def test_the_axes_of_a_segment_are_computed():
    labels = [
        "LFEO",
        "LFEA",
        "LTIA",
        "Pelvis_O",
        "Pelvis_X",
        "Pelvis_Y",
        "Pelvis_Z",
        "Foot_X",
        "Foot_Y",
        "ABCO",
        "ABCA",
        "ABCL",
        "ABCP",
    ]
    found = find_named_computed_points(labels, (), frozenset())
    np.testing.assert_array_equal(found, [True, True, False, *[True] * 4, False, False, *[True] * 4])


def test_computed_points_are_recognised_by_descriptions_and_lists():
    found = find_named_computed_points(["A", "B", "C", "D"], ["Virtual marker", "Left knee", "computed"], {"D"})
    np.testing.assert_array_equal(found, [True, False, True, True])


def test_computed_points_are_kept_apart_with_their_functions(tmp_path):
    markers = build_segment(3, 5)
    points = np.concatenate([markers[:, :2], compute_hip_centre(markers)[:, None], markers[:, 2:], markers[:, :1]], axis=1)
    take = read_points(tmp_path, points, ["LASI", "RASI", "X1", "LPSI", "RPSI", "SACR", "LHJC"])
    assert take.labels == ("LASI", "RASI", "LPSI", "RPSI", "SACR")
    assert take.other_labels == ("X1", "LHJC")
    computed = take.computed_points
    assert computed is not None
    assert computed.take.labels == ("LHJC", "X1")
    assert computed.evidence == ("name", "function")
    assert computed.list_parent_labels(0, take) == ()
    assert set(computed.list_parent_labels(1, take)) == {"LASI", "RASI", "LPSI", "RPSI"}
    np.testing.assert_allclose(computed.take.markers[:, 1], points[:, 2], atol=1e-6)
    np.testing.assert_array_equal(computed.take.point_columns, [6, 2])


def test_a_file_of_joint_centres_alone_is_read_with_a_note(tmp_path):
    take = read_points(tmp_path, build_segment(1, 4), ["LHJC", "RHJC", "LKJC", "RKJC"])
    assert take.labels == ("LHJC", "RHJC", "LKJC", "RKJC")
    assert "names of computed points" in " ".join(take.notes)


NUMBERED = {
    "numbers": (["1", "2", "3", "17"], ["Point 1", "Point 2", "Point 3", "Point 17"], "numbers in place of labels"),
    "repeated numbers": (["0", "0", "0", "0"], ["Point 1", "Point 2", "Point 3", "Point 4"], "numbers in place of labels"),
    "nothing": (["", "", "", ""], ["Point 1", "Point 2", "Point 3", "Point 4"], "no labels"),
}


@pytest.mark.parametrize("case", NUMBERED)
def test_files_with_numbers_in_place_of_labels_are_read_with_a_note(tmp_path, case):
    labels, names, words = NUMBERED[case]
    take = read_points(tmp_path, build_segment(1, 4), labels)
    assert take.labels == tuple(names)
    assert take.unlabelled is None
    assert words in " ".join(take.notes)


def test_descriptions_name_the_points_of_a_file_that_exchanges_them_with_labels(tmp_path):
    names = ["Head", "Neck", "LASI", "RASI"]
    take = read_points(tmp_path, build_segment(1, 4), ["1", "2", "3", "4"], **{"POINT:DESCRIPTIONS": names})
    assert take.labels == tuple(names)


def test_numbered_points_beside_labelled_ones_stay_unlabelled(tmp_path):
    take = read_points(tmp_path, build_segment(1, 4), ["LASI", "RASI", "SACR", "17"])
    assert take.labels == ("LASI", "RASI", "SACR")
    assert take.unlabelled is not None


def test_residuals_without_cameras_are_judged_by_the_markers_alone(tmp_path):
    points = build_segment(1, 20)
    labels = [*(f"{name}{axis}" for name in ("PEL", "LFE", "RFE", "LTI") for axis in "OALP"), "LASI", "RASI", "LPSI", "RPSI"]
    words = np.zeros(points.shape[:2])
    words[:, 16:] = 5  # measured markers, by a program that records residuals and no cameras
    take = read_points(tmp_path, points, labels, words)
    assert take.labels == ("LASI", "RASI", "LPSI", "RPSI")
    assert take.measured.all()


@needs_captures
def test_a_gait_file_with_model_outputs_has_measured_markers():
    take = capture.read_take(CAPTURES / "c3d" / "FMC_walk.c3d")
    assert len(take.labels) == 16
    assert take.measured.all()
    assert take.computed_points is not None
    assert len(take.computed_points.take.labels) == 36


@needs_captures
def test_landmarks_that_a_program_placed_on_segments_are_computed():
    take = capture.read_take(CAPTURES / "c3d" / "walking2.c3d")
    computed = take.computed_points
    assert computed is not None
    by_function = {
        label for label, evidence in zip(computed.take.labels, computed.evidence, strict=True) if evidence == "function"
    }
    assert by_function == {"LLFC", "LMFC", "RLFC", "RMFC", "LLMAL", "LMMAL", "RLMAL", "RMMAL"}


@needs_captures
@pytest.mark.parametrize(
    "name", ["c3d/HDM_bd_05-01_01_120", "c3d/squat", "c3d/tennis_serve_motive", "c3d/sprintbasket", "cmu/85_02"]
)
def test_no_marker_of_a_capture_is_computed(name):
    assert capture.read_take(CAPTURES / f"{name}.c3d").computed_points is None
