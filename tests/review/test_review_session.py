"""Cleaning a take again from the review."""

import json
import sys
import threading
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from mocapfix import pipeline
from mocapfix.errors import MocapfixError
from mocapfix.io import capture
from mocapfix.io.capture import read_take
from mocapfix.io.changes_file import Review, locate_correction, write_changes_file
from mocapfix.io.yaml_files import CorrectionModel
from mocapfix.model import windows
from mocapfix.model.faults import RequestedFill
from mocapfix.options import CleanOptions, FillOptions, parse_arguments
from mocapfix.review.review_session import (
    CleaningRun,
    ReviewSession,
    build_clean_command,
    describe_corrections,
    estimate_fills,
)
from mocapfix.review.take_files import find_cleaned_takes


def test_preview_is_cleaned_in_full(folder: Path):
    path = folder / "walk.report.json"
    report = json.loads(path.read_text(encoding="utf-8"))
    path.write_text(json.dumps({**report, "arguments": [*report["arguments"], "--fast"]}), encoding="utf-8")
    (take,) = find_cleaned_takes(folder)
    assert take.options.initialise.is_fast
    command = build_clean_command(take, [take], {"extra_formats": "gltf"})
    assert "--fast" not in command
    assert command[-5:] == ["--changes", "walk.changes.yaml", "--out", ".", "--overwrite"]


def test_an_export_adds_files_and_sets_rate_and_frames(folder: Path):
    (take,) = find_cleaned_takes(folder)
    export = {"extra_formats": "gltf,npz", "rigs": "blender", "characters": "mixamo", "output_rate_hz": "30", "trim": "5:20"}
    command = build_clean_command(take, [take], export)
    output = parse_arguments(command[6:])[0].output
    assert (output.extra_formats, output.rigs, output.characters) == (("gltf", "npz"), ("blender",), ("mixamo",))
    assert (output.output_rate_hz, output.trim) == (30.0, (5, 20))
    exported = replace(take, report={**take.report, "arguments": [*take.arguments, "--also", "gltf", "--fps", "30"]})
    again = parse_arguments(build_clean_command(exported, [exported], {"extra_formats": "trc", "output_rate_hz": ""})[6:])[
        0
    ].output
    assert again.extra_formats == ("gltf", "trc")  # what was written before is not left out
    assert again.output_rate_hz is None


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("extra_formats", "xyz"), ("rigs", "/etc/passwd"), ("characters", "me.glb"), ("output_rate_hz", "fast"), ("trim", "9"),
        ("subject_files", "a"), ("trim", 3),
    ],
)  # fmt: skip
def test_an_export_of_what_is_not_offered_is_refused(folder: Path, name: str, text: object):
    (take,) = find_cleaned_takes(folder)
    with pytest.raises(MocapfixError):
        build_clean_command(take, [take], {name: text})


def test_formats_fit_the_take(folder: Path):
    (take,) = find_cleaned_takes(folder)
    assert {"c3d", "trc", "csv", "gltf", "fbx"} <= set(take.export_choices["extra_formats"])
    animation = replace(take, report={**take.report, "take": {**take.report["take"], "animation": True}})
    assert not {"c3d", "trc", "csv"} & set(animation.export_choices["extra_formats"])
    assert "gltf" in animation.export_choices["extra_formats"]
    take.get_path("bvh").unlink()  # a take without a body
    assert take.export_choices == {"extra_formats": ["npz", "c3d", "trc", "csv"], "rigs": [], "characters": []}


def test_progress_is_the_share_of_the_time_of_the_cleaning_before(folder: Path):
    (take,) = find_cleaned_takes(folder)
    times = {"read": 1.0, "detect/body": 2.0, "solve/poses": 5.0, "write/bvh": 2.0}
    timed = replace(take, report={**take.report, "times": {name: {"seconds": each} for name, each in times.items()}})
    names = ["read", "detect/body", "solve/poses", "detect/body", "unknown", "write/bvh"]
    script = f"import sys\nfor name in {names}: print('stage:', name, file=sys.stderr)"
    statuses, is_done = [], threading.Event()

    def receive(status):
        statuses.append(status)
        if status.state == "done":
            is_done.set()

    CleaningRun([sys.executable, "-c", script], timed, receive)
    assert is_done.wait(30)
    assert [(each.stage, each.percent) for each in statuses[:-1]] == list(zip(names, [0, 10, 30, 30, 30, 80], strict=True))


def test_only_new_corrections_are_pending_where_an_older_report_does_not_tell(folder: Path) -> None:
    path = folder / "walk.report.json"
    report = json.loads(path.read_text(encoding="utf-8"))
    del report["corrections"]
    path.write_text(json.dumps(report), encoding="utf-8")
    session = ReviewSession(folder)
    opened = session.open_take("walk")
    added = {"kind": "wrong", "markers": [opened.view.labels[0]], "first": 10, "last": 12}
    for count in (1, 2):
        described = opened.edit(opened.store.revision, {"type": "add", "corrections": [added]})
        assert [each["is_pending"] for each in described["corrections"]] == [True] * count
    session.close()
    session = ReviewSession(folder)  # the ones that it finds may have been made
    assert [each["is_pending"] for each in session.open_take("walk").describe()["corrections"]] == [False] * 2
    session.close()


def test_corrections_are_pending_until_a_cleaning_has_made_them() -> None:
    one, other = (CorrectionModel(kind="wrong", markers=["C7"], first=first, last=20) for first in (10, 11))
    made, options = json.loads(json.dumps([one.model_dump(mode="json")])), FillOptions()
    assert [each["is_pending"] for each in describe_corrections([one, other, one], made, options)] == [False, True, True]
    assert [each["is_pending"] for each in describe_corrections([one], [], options)] == [True]
    assert [each["is_pending"] for each in describe_corrections([one, one, other], [one, one], options)] == [
        False,
        False,
        True,
    ]


def test_estimates_in_a_long_take_are_those_of_the_windows_in_which_it_is_cleaned(folder: Path, monkeypatch) -> None:
    for name, value in (("OVERLAP_S", 0.5), ("MIN_SHOWN_S", 0.5), ("CUT_SEARCH_S", 0.1), ("PIECE_S", 2.0)):
        monkeypatch.setattr(windows, name, value)
    monkeypatch.setattr(capture, "MAX_PIECE_FRAMES", 100)
    monkeypatch.setattr(pipeline, "plan_windows", partial(windows.plan_windows, window_frames=120))
    monkeypatch.chdir(folder.parent)
    options, path = CleanOptions().change(prior="none"), folder.parent / "walk.c3d"
    first_cut = pipeline.plan_subject(path, options, path.name)[0].window.end
    take = read_take(path)
    stretches = [(15, 24), (first_cut - 10, first_cut + 9)]  # within a window, and in two of them
    wrong = [
        CorrectionModel(kind="wrong", markers=["LTOE"], first=take.first_frame + first, last=take.first_frame + last)
        for first, last in stretches
    ]
    changes = folder / "long.changes.yaml"
    write_changes_file(changes, take, [], Review(corrections=tuple(locate_correction(each, take, "") for each in wrong)))
    options = options.change(review_files=(changes,))
    fills = [each.model_copy(update={"kind": "fill", "method": "cluster"}) for each in wrong]
    subject = folder.parent, path.name, options, path.name, ""
    found = [estimate_fills(subject, fills[:n], fill) for n, fill in enumerate(fills)]
    corrections = tuple(locate_correction(each, take, "") for each in (*wrong, *fills))
    write_changes_file(changes, take, [], Review(corrections=corrections))
    cleaned = pipeline.clean(path, options).take
    toe = take.labels.index("LTOE")
    for (first, last), estimates in zip(stretches, found, strict=True):
        assert {each["method"] for each in estimates} == {*get_args(RequestedFill)} - {"empty"}
        (samples,) = [each["samples"] for each in estimates if each["method"] == "cluster"]
        samples_of_clean = np.c_[cleaned.markers, cleaned.estimated_sd[..., None]][first : last + 1, toe]
        np.testing.assert_allclose(samples, samples_of_clean, atol=2e-6)
