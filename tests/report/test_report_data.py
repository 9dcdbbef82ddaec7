"""The record's keys and numbers, on a take of six frames and three markers that can be counted by hand."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mocapfix import marker_sets
from mocapfix.changes import UnfilledRun
from mocapfix.faults import Fault, Faults
from mocapfix.motion import STATUS_TEXTS, Motion
from mocapfix.report import report_data
from mocapfix.skeleton import load_cmu31_body
from mocapfix.subject import Subject
from mocapfix.take import Take

NAN = np.nan


def take(first_frame=101):
    markers = np.ones((6, 3, 3))
    markers[1:3, 0] = markers[:, 2] = NAN
    return Take(markers, ("Jim:LFHD", "Jim:RFHD", "C7"), 120.0, first_frame, Path("folder/walk.c3d"))


def plain(value):
    """-> the value as JSON gives it back; a NaN would be no JSON"""
    return json.loads(json.dumps(value, allow_nan=False))


@pytest.mark.parametrize("worn", ["cmu41", None])
def test_the_take(worn):
    assert plain(report_data.build_take_section(take(), worn)) == {
        "file": "walk.c3d",
        "frames": 6,
        "first_frame": 101,
        "rate_hz": 120.0,
        "markers": 3,
        "marker_set": worn,
        "labels": ["Jim:LFHD", "Jim:RFHD", "C7"],
    }


def sure(reason):
    return {"confidence": 1.0, "reason": reason}


def test_faults_in_the_files_own_frame_numbers():
    items = (Fault("gap", 0, 1, 2, 0.0123456, "Hidden."), Fault("absent", 2, 0, 5, NAN, "Never seen."))
    assert plain(report_data.build_fault_entries(take(), Faults(items))) == [
        {"kind": "gap", "marker": "Jim:LFHD", "first": 102, "last": 103, "severity_m": 0.01235} | sure("Hidden."),
        {"kind": "absent", "marker": "C7", "first": 101, "last": 106, "severity_m": None} | sure("Never seen."),
    ]


def test_no_faults_are_an_empty_list():
    assert report_data.build_fault_entries(take(), Faults()) == []


def person():
    worn = marker_sets.load_marker_set("cmu41")
    return Subject(load_cmu31_body().skeleton, worn.name, worn.labels, worn.joints, worn.marker_offsets, worn.marker_spread, 150)


def test_the_subjects_bones_are_lengths_by_joint():
    worn, skeleton = marker_sets.load_marker_set("cmu41"), load_cmu31_body().skeleton
    said = plain(report_data.build_subject_section(person()))
    assert set(said) == {"marker_set", "frames", "bones_m", "spread_m"}
    assert (said["marker_set"], said["frames"]) == ("cmu41", 150)
    shin = skeleton.find_joint("LeftFoot")
    assert said["bones_m"]["LeftFoot"] == pytest.approx(np.linalg.norm(skeleton.offsets[shin]), abs=6e-5)
    assert "Hips" not in said["bones_m"]  # the root has no parent
    assert list(said["spread_m"]) == list(worn.labels)
    assert said["spread_m"]["LFHD"] == pytest.approx(worn.marker_spread[worn.labels.index("LFHD")], abs=6e-5)


def test_the_solves_residuals_iterations_and_statuses():
    sure = np.full((6, 31), 0.004)
    sure[:, 4] = 0.001 * np.arange(6)
    motion = Motion(np.zeros((6, 3)), np.zeros((6, 1, 3, 3)), np.array([0, 0, 3, 0, 1, 0]), np.arange(6), np.zeros((6, 3)), sure)
    error = np.full((6, 3), NAN)
    error[:, 0], error[:5, 1] = 0.002, [0.001, 0.002, 0.003, 0.004, 0.005]
    said = plain(report_data.build_solve_section(take(), person(), motion, error, "gaussian", 2.0, "hybrik-x"))
    residual = said["marker_residual_mm"]
    assert set(said) == {"marker_residual_mm", "joint_deviation_mm", "start", "prior", "iterations_mean", "status"}
    assert said["start"] == "hybrik-x"
    assert said["prior"] == {"name": "gaussian", "scale": 2.0}
    assert len(said["joint_deviation_mm"]) == 31
    assert said["joint_deviation_mm"]["Hips"] == {"mean": 4.0, "p95": 4.0}
    assert said["joint_deviation_mm"]["LeftFoot"] == {"mean": 2.5, "p95": 4.75}
    assert residual["mean"] == pytest.approx((6 * 2 + 15) / 11, abs=1e-3)
    assert residual["p95"] == pytest.approx(4.5)
    assert residual["by_marker"]["Jim:RFHD"] == {"mean": 3.0, "p95": 4.8}
    assert set(residual["by_marker"]) == {"Jim:LFHD", "Jim:RFHD"}  # what was never held against the body is not there
    assert said["iterations_mean"] == 2.5
    assert said["status"] == {STATUS_TEXTS[0]: 4, STATUS_TEXTS[1]: 1, STATUS_TEXTS[3]: 1}


def test_a_solve_that_no_marker_could_be_held_against():
    motion = Motion(
        np.zeros((6, 3)), np.zeros((6, 1, 3, 3)), np.full(6, 3), np.zeros(6, int), np.zeros((6, 3)), np.zeros((6, 31))
    )
    said = plain(report_data.build_solve_section(take(), person(), motion, np.full((6, 3), NAN), "none", 1.0, "registration"))
    assert said["prior"] is None
    assert said["marker_residual_mm"] == {"mean": None, "p95": None, "by_marker": {}}


def test_the_fill_counts_what_was_filled_mended_and_left():
    before = take()
    markers = before.markers.copy()
    markers[1, 0] = 2.0  # filled
    markers[0, 1] = 3.0  # mended
    markers[5, 1] = NAN  # a doubted sample that nothing could replace
    left = (UnfilledRun(0, 2, 2, "too far"), UnfilledRun(1, 5, 5, "unsure"), UnfilledRun(2, 0, 5, "never seen"))
    deviation = np.full((6, 3), NAN)
    deviation[[1, 0], [0, 1]] = 0.001
    markers[3, 1] = 4.0  # another label's sample
    source = before.source_points.copy()
    source[3, 1] = 7
    after = replace(before.replace_markers(markers, deviation), relabelled_points=source)
    said = plain(report_data.build_fill_section(before, before, after, left))
    assert said == {
        "missing_before": 8,
        "filled": 1,
        "mended": 1,
        "relabelled": 1,
        "left_empty": 8,
        "left": [
            {"marker": "Jim:LFHD", "first": 103, "last": 103, "reason": "too far"},
            {"marker": "Jim:RFHD", "first": 106, "last": 106, "reason": "unsure"},
            {"marker": "C7", "first": 101, "last": 106, "reason": "never seen"},
        ],
    }


def test_every_key_of_the_record_is_in_its_documentation():
    said = report_data.__doc__ or ""
    for made in (report_data.build_take_section(take(), None), report_data.build_fill_section(take(), take(), take(), ())):
        assert all(key in said for key in made)
    assert all(
        key in said
        for key in ("bones_m", "spread_m", "by_marker", "joint_deviation_mm", "iterations_mean", "severity_m", "notes", "total")
    )
