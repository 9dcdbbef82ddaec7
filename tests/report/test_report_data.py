"""Keys and numbers of the JSON report, on a take of six frames and three markers."""

import json
from dataclasses import replace
from pathlib import Path
from typing import get_type_hints

import numpy as np
import pytest

from mocapfix.model.changes import UnfilledRun
from mocapfix.model.faults import Fault, Faults
from mocapfix.model.motion import FrameStatus, Motion
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.model.subject import Subject
from mocapfix.model.take import Take
from mocapfix.report import report
from mocapfix.report.build_report import (
    build_fault_entries,
    build_fill_section,
    build_solve_section,
    build_subject_section,
    build_take_section,
)
from mocapfix.solve.lost_in_sight import LostPart
from mocapfix.subject.library import load_marker_set

NAN = np.nan


def build_take(first_frame=101):
    markers = np.ones((6, 3, 3))
    markers[1:3, 0] = markers[:, 2] = NAN
    return Take(markers, ("Jim:LFHD", "Jim:RFHD", "C7"), 120.0, first_frame, Path("folder/walk.c3d"))


def encode(value):
    """Return the value as JSON gives it back; NaN is not valid JSON."""
    return json.loads(json.dumps(value, allow_nan=False))


@pytest.mark.parametrize("marker_set", ["cmu41", None])
def test_take_section(marker_set):
    assert encode(build_take_section(build_take(), marker_set)) == {
        "file": "walk.c3d",
        "frames": 6,
        "first_frame": 101,
        "rate_hz": 120.0,
        "markers": 3,
        "marker_set": marker_set,
        "labels": ["Jim:LFHD", "Jim:RFHD", "C7"],
    }


def test_faults_have_the_files_frame_numbers():
    items = (Fault("gap", 0, 1, 2, 0.0123456, "Hidden."), Fault("absent", 2, 0, 5, NAN, "Never visible."))
    certain = {"confidence": 1.0}
    assert encode(build_fault_entries(build_take(), Faults(items))) == [
        certain | {"kind": "gap", "marker": "Jim:LFHD", "first": 102, "last": 103, "severity_m": 0.01235, "reason": "Hidden."},
        certain | {"kind": "absent", "marker": "C7", "first": 101, "last": 106, "severity_m": None, "reason": "Never visible."},
    ]


def test_severity_of_rotations_is_in_degrees():
    fault = Fault("pop", 0, 1, 2, np.radians(12.3456), "Turns.", severity_unit="rad")
    (entry,) = build_fault_entries(build_take(), Faults((fault,)))
    assert (entry["severity_m"], entry.get("severity_deg")) == (None, 12.35)


def test_no_faults_are_an_empty_list():
    assert build_fault_entries(build_take(), Faults()) == []


@pytest.fixture(scope="module")
def subject():
    marker_set = load_marker_set("cmu41")
    return Subject(
        load_cmu31_body().skeleton,
        marker_set.name,
        marker_set.labels,
        marker_set.joints,
        marker_set.marker_offsets,
        marker_set.marker_spread,
        150,
    )


def test_subject_section_has_bone_lengths_by_joint(subject):
    marker_set, skeleton = load_marker_set("cmu41"), load_cmu31_body().skeleton
    section = encode(build_subject_section(subject))
    assert set(section) == {"marker_set", "frames", "bones_m", "spread_m"}
    assert (section["marker_set"], section["frames"]) == ("cmu41", 150)
    foot = skeleton.find_joint("LeftFoot")
    assert section["bones_m"]["LeftFoot"] == pytest.approx(np.linalg.norm(skeleton.offsets[foot]), abs=6e-5)
    assert "Hips" not in section["bones_m"]  # the root has no parent
    assert list(section["spread_m"]) == list(marker_set.labels)
    spread_m = marker_set.marker_spread[marker_set.labels.index("LFHD")]
    assert section["spread_m"]["LFHD"] == pytest.approx(spread_m, abs=6e-5)


def build_motion(status, iterations, joint_sd):
    return Motion(np.zeros((6, 3)), np.zeros((6, 1, 3, 3)), status, iterations, np.zeros((6, 3)), joint_sd)


def test_solve_section_has_residuals_iterations_and_statuses(subject):
    joint_sd = np.full((6, 31), 0.004)
    joint_sd[:, 4] = 0.001 * np.arange(6)
    motion = build_motion(np.array([0, 0, 3, 0, 1, 0]), np.arange(6), joint_sd)
    residual_m = np.full((6, 3), NAN)
    residual_m[:, 0], residual_m[:5, 1] = 0.002, [0.001, 0.002, 0.003, 0.004, 0.005]
    lost = LostPart("left foot", np.arange(6) < 2, np.full(6, 0.1), np.ones((6, 3), bool))
    section = encode(
        build_solve_section(build_take(), subject, motion, residual_m, "gaussian", 2.0, "hybrik-x", lost_parts=[lost])
    )
    residual = section["marker_residual_mm"]
    assert set(section) == {
        "marker_residual_mm",
        "solved_joints",
        "joint_deviation_mm",
        "start",
        "prior",
        "iterations_mean",
        "lost_in_sight",
        "status",
    }
    assert section["lost_in_sight"] == {"left foot": 2}
    assert section["start"] == "hybrik-x"
    assert section["prior"] == {"name": "gaussian", "scale": 2.0}
    assert len(section["joint_deviation_mm"]) == 31
    assert section["joint_deviation_mm"]["Hips"] == {"mean": 4.0, "p95": 4.0}
    assert section["joint_deviation_mm"]["LeftFoot"] == {"mean": 2.5, "p95": 4.75}
    assert residual["mean"] == pytest.approx((6 * 2 + 15) / 11, abs=1e-3)
    assert residual["p95"] == pytest.approx(4.5)
    assert residual["by_marker"]["Jim:RFHD"] == {"mean": 3.0, "p95": 4.8}
    assert set(residual["by_marker"]) == {"Jim:LFHD", "Jim:RFHD"}  # markers without residuals are left out
    assert section["iterations_mean"] == 2.5
    assert section["status"] == {FrameStatus(0).description: 4, FrameStatus(1).description: 1, FrameStatus(3).description: 1}


def test_solve_section_without_any_residual(subject):
    motion = build_motion(np.full(6, 3), np.zeros(6, int), np.zeros((6, 31)))
    residual_m = np.full((6, 3), NAN)
    section = encode(build_solve_section(build_take(), subject, motion, residual_m, "none", 1.0, "registration"))
    assert section["prior"] is None
    assert section["lost_in_sight"] == {}
    assert section["marker_residual_mm"] == {"mean": None, "p95": None, "by_marker": {}}


def test_fill_section_counts_filled_replaced_relabelled_and_empty_samples():
    before = build_take()
    markers = before.markers.copy()
    markers[1, 0] = 2.0  # filled
    markers[0, 1] = 3.0  # replaced
    markers[5, 1] = NAN  # faulty and left empty
    unfilled_runs = (UnfilledRun(0, 2, 2, "gap"), UnfilledRun(1, 5, 5, "uncertain"), UnfilledRun(2, 0, 5, "never visible"))
    sample_sd = np.full((6, 3), NAN)
    sample_sd[[1, 0], [0, 1]] = 0.001
    markers[3, 1] = 4.0  # of another label
    points = before.source_points.copy()
    points[3, 1] = 7
    after = replace(before.replace_markers(markers, sample_sd), relabelled_points=points)
    assert encode(build_fill_section(before, before, after, unfilled_runs)) == {
        "missing_before": 8,
        "filled": 1,
        "replaced": 1,
        "relabelled": 1,
        "left_empty": 8,
        "unfilled": [
            {"marker": "Jim:LFHD", "first": 103, "last": 103, "reason": "gap"},
            {"marker": "Jim:RFHD", "first": 106, "last": 106, "reason": "uncertain"},
            {"marker": "C7", "first": 101, "last": 106, "reason": "never visible"},
        ],
        "left_by_marker": [
            {"marker": "C7", "samples": 6, "reasons": {"never visible": 6}},
            {"marker": "Jim:LFHD", "samples": 1, "reasons": {"gap": 1}},
            {"marker": "Jim:RFHD", "samples": 1, "reasons": {"uncertain": 1}},
        ],
    }


def test_sections_have_exactly_the_declared_keys(subject):
    take = build_take()
    assert set(build_take_section(take, None)) <= set(get_type_hints(report.TakeSection))
    assert set(build_fill_section(take, take, take, ())) == set(get_type_hints(report.FillSection))
    assert set(build_subject_section(subject)) == set(get_type_hints(report.SubjectSection))
