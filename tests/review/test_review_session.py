"""Cleaning a take again from the review."""

import json
import sys
import threading
from dataclasses import replace
from pathlib import Path

import pytest

from mocapfix.errors import MocapfixError
from mocapfix.io.yaml_files import CorrectionModel
from mocapfix.options import parse_arguments
from mocapfix.review.review_session import CleaningRun, ReviewSession, build_clean_command, describe_corrections
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
    made = json.loads(json.dumps([one.model_dump(mode="json")]))
    assert [each["is_pending"] for each in describe_corrections([one, other, one], made)] == [False, True, True]
    assert [each["is_pending"] for each in describe_corrections([one], [])] == [True]
    assert [each["is_pending"] for each in describe_corrections([one, one, other], [one, one])] == [False, False, True]
