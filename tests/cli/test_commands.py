"""The command line: output of the commands, exit statuses, and error messages."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from mocapfix.cli.clean import describe_laboratory
from mocapfix.cli.console import COMPILATION_MESSAGE
from mocapfix.kernels import compilation
from mocapfix.option import parse_frames, parse_subject_files
from mocapfix.options import build_clean_options
from tests.c3d_files import c3d_bytes
from tests.conftest import build_c3d

KINDS = ("c3d", "bvh", "subject.yaml", "changes.yaml", "report.json", "report.html", "rrd")


def flat(text):
    return " ".join(text.split())


# the commands


def test_help_lists_the_commands_in_order():
    command = [sys.executable, "-m", "mocapfix", "--help"]
    done = subprocess.run(command, capture_output=True, text=True, encoding="utf-8", check=False)
    assert (done.returncode, done.stderr) == (0, "")
    commands = ("demo", "inspect", "calibrate", "clean", "view", "run")
    places = [re.search(rf"^\W*{each}\s+\S", done.stdout, re.M) for each in commands]
    assert None not in places
    starts = [place.start() for place in places if place]
    assert starts == sorted(starts)
    assert "usage: mocapfix" in done.stdout


def test_help_of_clean_shows_units_and_defaults(mocapfix):
    status, out, _ = mocapfix("clean", "--help")
    text = flat(out.replace("│", " "))
    assert status == 0
    for option in ("--out DIR", "--marker-set NAME|FILE", "--subject FILE", "--prior NAME|none", "--prior-scale X",
                   "--init METHOD", "--overwrite", "--json", "--max-gap SECONDS", "--max-sd MM", "--limit MM", "--keep LABEL,...",
                   "--frames FIRST:LAST"):  # fmt: skip
        assert option in text
    assert "(default: 600.0)" in text
    assert "(default: autoencoder)" in text


def test_demo_compares_with_the_truth(mocapfix, tmp_path):
    status, out, _ = mocapfix("demo", "--out", tmp_path / "here")
    assert status == 0
    assert {path.name for path in (tmp_path / "here").iterdir()} == {"demo.c3d", "demo.mocapfix"}
    assert {path.name for path in (tmp_path / "here" / "demo.mocapfix").iterdir()} == {f"demo.{kind}" for kind in KINDS}
    assert "10 s of 41 markers" in flat(out)
    heading = next(line for line in out.splitlines() if "linear" in line)
    assert re.search(r"linear.*cubic.*mocapfix", heading)
    table = out.partition("Compared with the known truth")[2].partition("demo.c3d:")[0]
    rows = {name: [float(x) for x in re.findall(r"\d+\.\d", line.split(name)[1])] for name in ("gaps under 0.5 s", "spikes")
            for line in table.splitlines() if name in line}  # fmt: skip
    assert len(rows) == 2
    for linear, cubic, ours in rows.values():
        assert ours < min(linear, cubic)
    assert "To see the recording: mocapfix view" in flat(out)
    assert "mocapfix review" in flat(out)


def test_inspect_lists_faults(mocapfix, brief):
    status, out, err = mocapfix("inspect", brief.path)
    assert (status, err) == (0, "")
    text = flat(out)
    assert text.startswith("brief.c3d: 41 markers, frames 301 to 420 at 120 Hz. ")
    assert "41 of its 41 markers were found." in text
    for marker, kind, frames in (("RELB", "gap", "341-360"), ("LKNE", "gap", "371-390"), ("STRN", "spike", "321-321")):
        assert re.search(rf"{marker}\W+{kind}\W+{frames}", text)


def test_inspect_of_a_sound_take(mocapfix, cleaned, tmp_path):
    sound = tmp_path / "sound.c3d"
    sound.write_bytes(build_c3d(cleaned.truth.marker_positions[:60], cleaned.truth.labels))
    assert "No faults were detected." in mocapfix("inspect", sound)[1]


def test_inspect_writes_one_json_document(mocapfix, brief):
    status, out, _ = mocapfix("inspect", brief.path, "--json")
    inspection = json.loads(out)
    assert (status, list(inspection)) == (0, ["take", "faults", "notes"])
    assert (inspection["take"]["frames"], inspection["take"]["first_frame"], inspection["take"]["marker_set"]) == (
        120,
        301,
        "cmu41",
    )
    assert {"RELB", "LKNE", "STRN"} <= {fault["marker"] for fault in inspection["faults"]}


def test_calibrate_then_clean_with_that_subject(mocapfix, brief, tmp_path):
    subject = tmp_path / "person.yaml"
    status, out, _ = mocapfix("calibrate", brief.path, "-o", subject)
    assert status == 0
    assert "41 markers on 31 joints, from" in flat(out)
    status, out, _ = mocapfix("clean", brief.path, "--subject", subject, "--out", tmp_path / "out")
    assert status == 0
    assert (tmp_path / "out" / "brief.subject.yaml").read_text(encoding="utf-8") == subject.read_text(encoding="utf-8")
    status, _, err = mocapfix("calibrate", brief.path, "-o", subject)
    assert status == 1
    assert flat(err) == f"{subject}: already exists; give --overwrite to replace it, or choose another name or folder."


def test_a_lost_arm_is_inferred_from_the_memory_that_calibrate_wrote(mocapfix, cleaned, tmp_path):
    markers, labels = cleaned.truth.marker_positions[:240].copy(), cleaned.truth.labels
    (tmp_path / "whole.c3d").write_bytes(build_c3d(markers, labels))
    written = ("-o", tmp_path / "p.yaml", "--person-memory", tmp_path / "p.safetensors")
    status, out, _ = mocapfix("calibrate", tmp_path / "whole.c3d", *written)
    assert status == 0
    assert f"{tmp_path / 'p.safetensors'}: how the person moves in 1 take." in flat(out)
    arm = [labels.index(label) for label in ("LUPA", "LELB", "LFRM", "LWRA", "LWRB", "LFIN")]
    markers[100:190, arm] = np.nan
    (tmp_path / "lost.c3d").write_bytes(build_c3d(markers, labels))
    read = ("--subject", tmp_path / "p.yaml", "--person-memory", tmp_path / "p.safetensors", "--out", tmp_path / "out")
    status, _, _ = mocapfix("clean", tmp_path / "lost.c3d", *read)
    assert status == 0
    notes = json.loads((tmp_path / "out" / "lost.report.json").read_text(encoding="utf-8"))["notes"]
    assert "Inferred from the memory of the person: left arm in frames 101\u2013190 from whole, 0:00-0:02." in notes
    status, _, err = mocapfix("clean", tmp_path / "lost.c3d", "--person-memory", tmp_path / "p.yaml", "--out", tmp_path / "no")
    assert status == 1
    assert "p.yaml: is not the memory of a person" in flat(err)
    status, _, err = mocapfix("calibrate", tmp_path / "whole.c3d", "-o", tmp_path, "--person-memory", tmp_path / "x.safetensors")
    assert status == 2
    assert "--person-memory is of one person" in flat(err)
    same = ("-o", tmp_path / "p.yaml", "--person-memory", tmp_path / "p.yaml", "--overwrite")
    status, _, err = mocapfix("calibrate", tmp_path / "whole.c3d", *same)
    assert status == 2
    assert "give --output another file" in flat(err)


def test_clean_writes_beside_the_take_and_prints_a_summary(mocapfix, brief, tmp_path):
    take = tmp_path / "walk.1.c3d"
    take.write_bytes(brief.path.read_bytes())
    status, out, _ = mocapfix("clean", take, "--subject", brief.subject)
    assert status == 0
    assert {path.name for path in (tmp_path / "walk.1.mocapfix").iterdir()} == {f"walk.1.{kind}" for kind in KINDS}
    assert "walk.1.c3d: 40 samples were missing, 40 filled; 1 faulty ones replaced; 0 left empty." in flat(out)
    assert "changed: 2 gaps and 1 spike." in flat(out)
    assert re.search(r"clean again with --changes .* --overwrite and the same options", flat(out))
    status, _, err = mocapfix("clean", take, "--subject", brief.subject)
    assert status == 1
    assert "walk.1.c3d: already exists; give --overwrite to replace it, or choose another name or folder." in err
    assert mocapfix("clean", take, "--subject", brief.subject, "--overwrite")[0] == 0


def test_clean_with_json_prints_the_report_and_nothing_else(mocapfix, brief, tmp_path):
    status, out, _ = mocapfix("clean", brief.path, "--subject", brief.subject, "--out", tmp_path, "--json")
    assert status == 0
    assert json.loads(out) == json.loads((tmp_path / "brief.report.json").read_text(encoding="utf-8"))


def test_options_restrict_what_is_changed(mocapfix, brief, tmp_path):
    status, out, _ = mocapfix(
        "clean", brief.path, "--subject", brief.subject, "--out", tmp_path, "--json", "--keep", "RELB, STRN", "--frames", "361:"
    )
    fill = json.loads(out)["fill"]
    assert status == 0
    assert (fill["missing_before"], fill["filled"], fill["replaced"], fill["left_empty"]) == (40, 20, 0, 20)
    assert [(each["marker"], each["first"], each["last"]) for each in fill["unfilled"]] == [("RELB", 341, 360)]
    assert "excluded from editing by --keep or --frames" in fill["unfilled"][0]["reason"]


def test_purpose_lab_leaves_ends_empty_and_is_suggested_once(mocapfix, brief, tmp_path):
    markers = brief.markers.copy()
    markers[:5, brief.labels.index("RKNE")] = np.nan
    markers[-3:, brief.labels.index("LWRA")] = np.nan
    takes = [tmp_path / f"{name}.c3d" for name in ("one", "two")]
    for take in takes:
        take.write_bytes(build_c3d(markers, brief.labels, first=301))
    arguments = ["clean", *takes, "--subject", brief.subject, "--out", tmp_path / "out", "--overwrite"]
    status, out, _ = mocapfix(*arguments, "--purpose", "lab", "--json")
    reports = json.loads(out)
    assert status == 0
    for report in reports:
        ends = {each["marker"]: each["reasons"] for each in report["fill"]["left_by_marker"]}
        assert ends == {
            "RKNE": {"before the marker is first measured (--max-end-sd 0)": 5},
            "LWRA": {"after the marker is last measured (--max-end-sd 0)": 3},
        }
        assert report["contacts"]["feet"]["mode"] == "off"
        assert report["arguments"][1:3] == ["--purpose", "lab"]
        assert not {"--max-sd", "--feet"} & set(report["arguments"])
    assert mocapfix(*arguments, "--purpose", "lab", "--max-end-sd", "60")[1].count("0 left empty") == 2


@pytest.mark.parametrize(
    ("evidence", "options", "note"),
    [
        ({"a.c3d": "legs only"}, {}, "a.c3d looks like a take of a laboratory (legs only): --purpose lab writes only what"),
        ({"a.c3d": "", "b.c3d": "force plates", "c.c3d": "legs only"}, {}, "2 takes, such as b.c3d, look like those of a"),
        ({"a.c3d": ""}, {}, ""),
        ({"a.c3d": "legs only"}, {"purpose": "animation"}, ""),
        ({"a.c3d": "legs only"}, {"purpose": "lab"}, ""),
    ],
)
def test_laboratory_is_suggested_unless_a_purpose_is_given(evidence, options, note):
    found = describe_laboratory(evidence, build_clean_options(**options))
    assert found.startswith(note)
    assert bool(found) == bool(note)
    assert len(found) <= 200


def test_bad_take_does_not_stop_the_others(mocapfix, brief, tmp_path):
    takes = []
    for name in ("one", "two", "three"):
        takes.append(tmp_path / f"{name}.c3d")
        takes[-1].write_bytes(brief.path.read_bytes() if name != "two" else b"nothing of the kind")
    status, out, err = mocapfix("clean", *takes, "--subject", brief.subject, "--out", tmp_path / "out", "--json")
    assert status == 1
    assert [report["take"]["file"] for report in json.loads(out)] == ["one.c3d", "three.c3d"]
    assert "two.c3d: has no format that mocapfix reads" in err
    written = {path.name for path in (tmp_path / "out").iterdir()}
    assert written == {f"{name}.{kind}" for name in ("one", "three") for kind in KINDS}


@pytest.mark.parametrize("overwrite", [[], ["--overwrite"]])
def test_takes_of_one_name_do_not_overwrite_each_other(mocapfix, brief, tmp_path, overwrite):
    for folder in ("monday", "tuesday"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "walk.c3d").write_bytes(brief.path.read_bytes())
    takes = [tmp_path / folder / "walk.c3d" for folder in ("monday", "tuesday")]
    status, out, err = mocapfix("clean", *takes, "--subject", brief.subject, "--out", tmp_path / "out", "--json", *overwrite)
    assert status == 1
    assert len(json.loads(out)) == 1
    assert "another take of this name was written" in err


def test_view_opens_the_recording(mocapfix, cleaned, monkeypatch):
    commands = []
    monkeypatch.setattr(
        subprocess, "run", lambda command, **_: commands.append(command) or subprocess.CompletedProcess(command, 0)
    )
    assert mocapfix("view", cleaned.outputs["rrd"].parent)[0] == 0
    assert mocapfix("view", cleaned.outputs["rrd"])[0] == 0
    assert [command[-1] for command in commands] == [str(cleaned.outputs["rrd"])] * 2


def test_view_without_a_recording_or_display_is_an_error(mocapfix, cleaned, tmp_path, monkeypatch):
    for nothing in (tmp_path, tmp_path / "gone.rrd"):
        status, _, err = mocapfix("view", nothing)
        assert (status, err.strip()) == (
            1, f"{nothing}: holds no recording (.rrd); name the output folder of clean, or a recording in it.",
        )  # fmt: skip
    monkeypatch.setattr(subprocess, "run", lambda command, **_: subprocess.CompletedProcess(command, 7))
    status, _, err = mocapfix("view", cleaned.outputs["rrd"])
    assert status == 1
    assert "rerun could not show it (exit 7); check that this machine has a display." in err


# wrong usage


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["clean"], "clean: name at least one take."),
        (["calibrate", "-o", "person.yaml"], "calibrate: name at least one take."),
        (["clean", "a.c3d", "--max-gap", "0"], "--max-gap must be greater than 0 s, not 0."),
        (["clean", "a.c3d", "--frames", "100"], "--frames must be FIRST:LAST, as in 100:250, not '100'."),
        (["clean", "a.c3d", "--frames", "a:b"], "--frames must be FIRST:LAST, as in 100:250, not 'a:b'."),
        (["clean", "a.c3d", "--max-gap", "long"], "--max-gap must be a number, not 'long'."),
        (["clean", "a.c3d", "--detect-max-rounds", "1.5"], "--detect-max-rounds must be a whole number, not '1.5'."),
        (["clean", "--out", "--mirror", "a.c3d"], "--out"),
        (["clean", "a.c3d", "--prior-scale", "0"], "--prior-scale must be greater than 0 and finite, not 0."),
        (["clean", "a.c3d", "--maxgap", "1"], "--maxgap"),
        (["clean", "a.c3d", "--init", "hybrik"], "--init must be one of hybrik-x, hybrik-adaptive, hybrik-naive, "),
        (["mend", "a.c3d"], "mend"),
        (["calibrate", "a.c3d"], "--output"),
    ],
)
def test_wrong_usage_is_status_2(mocapfix, arguments, sentence):
    status, out, err = mocapfix(*arguments)
    assert (status, out) == (2, "")
    assert sentence in flat(err.replace("│", " "))


@pytest.mark.parametrize("arguments", [["--up", "y"], ["--up", "-y"], ["--up=-y"], ["--up", "-Y"]])
def test_up_axes_are_named_in_either_case_and_with_a_sign(mocapfix, tmp_path, arguments):
    status, _, err = mocapfix("clean", tmp_path / "none.c3d", *arguments)
    assert status == 1
    assert "none.c3d: there is no such file" in flat(err)


@pytest.mark.parametrize(
    ("text", "frames"),
    [(":", None), ("100:250", (100, 250)), ("100:", (100, 2**62)), (":250", (-(2**62), 250)), ("7:7", (7, 7))],
)
def test_frames_are_first_to_last(text, frames):
    assert parse_frames(text) == frames


@pytest.mark.parametrize(
    ("text", "files"),
    [
        ("jim.yaml", "jim.yaml"),
        ("Jim=jim.yaml, Ann=a/ann.yaml", (("Jim", Path("jim.yaml")), ("Ann", Path("a/ann.yaml")))),
        ("Jim:=jim.yaml", (("Jim", Path("jim.yaml")),)),
    ],
)
def test_subject_files_may_be_named(text, files):
    assert parse_subject_files(text) == files


@pytest.mark.parametrize("text", ["Jim=", "=jim.yaml", "Jim=jim.yaml,ann.yaml", "Jim=a.yaml,jim=b.yaml"])
def test_subject_files_without_names_are_wrong_usage(mocapfix, text):
    status, _, err = mocapfix("clean", "a.c3d", "--subject", text)
    assert status == 2
    assert "--subject must be FILE, or NAME=FILE,... with a name only once" in flat(err.replace("│", " "))


def test_file_with_an_equals_sign_is_a_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a=b.yaml").touch()
    assert parse_subject_files("a=b.yaml") == "a=b.yaml"


def test_calibrate_writes_a_file_for_each_person_into_a_folder(mocapfix, brief, tmp_path):
    data = brief.path.read_bytes()
    for name in ("a.c3d", "b.c3d"):
        (tmp_path / name).write_bytes(data)
    status, out, _ = mocapfix("calibrate", tmp_path / "a.c3d", tmp_path / "b.c3d", "-o", tmp_path / "people")
    assert status == 0
    assert [path.name for path in (tmp_path / "people").iterdir()] == ["person.subject.yaml"]
    assert "person.subject.yaml: 41 markers on 31 joints" in flat(out)
    status, _, err = mocapfix("calibrate", tmp_path / "a.c3d", "-o", tmp_path / "people")
    assert status == 1
    assert "person.subject.yaml: already exists" in flat(err)


# bad input


def two_markers_at_a_time(brief):
    markers = np.full_like(brief.markers, np.nan)
    markers[:60, :2], markers[60:, 2:4] = brief.markers[:60, :2], brief.markers[60:, 2:4]
    return build_c3d(markers, brief.labels)


FILES = {
    "cut off": (lambda brief: brief.path.read_bytes()[:-20_000], r"is cut off: 120 frames are declared and \d+ are there; copy"),
    "empty": (lambda _: b"", r"is empty \(0 bytes\); copy or export it again"),
    "random": (lambda _: np.random.default_rng(0).bytes(8000), r"has no format that mocapfix reads; export the capture as"),
    "random, nearly": (lambda _: b"\x02\x50" + np.random.default_rng(1).bytes(8000), r"; (copy|export) "),
    "text": (lambda _: b"Frame\tX\tY\tZ\n" * 200, r"has no format that mocapfix reads; export the capture as"),
    "without points": (lambda _: c3d_bytes(np.zeros((5, 0, 3)), [], extra={"POINT:LABELS": None}), r"has no points; export"),
    "negative residuals": (
        lambda _: c3d_bytes(np.full((5, 4, 3), 100.0), list("ABCD"), np.full((5, 4), -1.0)),
        r"all samples of its markers are missing \(in a C3D, a residual below 0 says so\); check the labels and the export",
    ),
    "two markers": (two_markers_at_a_time, r"no frame shows 3 markers, so nothing can be estimated; check the labels"),
}


@pytest.mark.parametrize("kind", FILES)
def test_invalid_file_is_named_and_leaves_nothing_behind(mocapfix, brief, tmp_path, kind):
    make, sentence = FILES[kind]
    take = tmp_path / "bad [1].c3d"
    take.write_bytes(make(brief))
    check_refused(mocapfix("clean", take), take.name, sentence)
    check_refused(mocapfix("clean", take, "--out", tmp_path / "out", "--json"), take.name, sentence)
    assert [path.name for path in tmp_path.iterdir()] == [take.name]


def test_kernels_are_compiled_only_once_the_take_is_read(mocapfix, brief, tmp_path, monkeypatch):
    compilations = []
    monkeypatch.setattr(compilation, "is_precompiled", lambda: bool(compilations))
    monkeypatch.setattr(compilation, "precompile_kernels", lambda report_progress: compilations.append(report_progress(1, 2)))
    cut_off = tmp_path / "cut off.c3d"
    cut_off.write_bytes(FILES["cut off"][0](brief))
    check_refused(mocapfix("clean", cut_off), cut_off.name, FILES["cut off"][1])
    assert compilations == []
    status, _, err = mocapfix("clean", brief.path, brief.path, "--subject", brief.subject, "--out", tmp_path / "out")
    assert (status, len(compilations)) == (1, 1)  # the second take has the name of the first
    assert [line.startswith(COMPILATION_MESSAGE) for line in err.strip().splitlines()] == [True, False]


def test_missing_file_folder_and_other_formats_are_errors(mocapfix, cleaned, tmp_path):
    check_refused(mocapfix("clean", tmp_path / "gone.c3d"), "gone.c3d", "there is no such file; check the name and the folder")
    for folder in (tmp_path, "."):
        check_refused(mocapfix("clean", folder), Path(folder).name, "is a folder; name the files in it")
    page = cleaned.outputs["report.html"]
    done = mocapfix("clean", page, "--out", tmp_path / "out")
    check_refused(done, page.name, "has no format that mocapfix reads; export the capture as")
    for command in ("inspect", "clean"):
        check_refused(mocapfix(command, tmp_path / "gone.c3d"), "gone.c3d", "there is no such file")
    check_refused(mocapfix("calibrate", tmp_path / "gone.c3d", "-o", tmp_path / "x.yaml"), "gone.c3d", "there is no such file")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--marker-set", "cleveland"], "cleveland: no such marker set; name one of body25, cast, cgm2, cmu41, "),
        (["--marker-set", "helen-hayes"], "brief.c3d: helen-hayes does not fit: "),
        (["--prior", "dancing"], "There is no trained prior 'dancing'; choose one of: "),
        (["--prior", "mean-pose"], "There is no trained prior 'mean-pose'; choose one of: "),
        (["--frames", "1:20"], "brief.c3d: --frames 1:20 is not in the take, which has frames 301 to 420"),
        (["--keep", "NOSE"], "brief.c3d: has no marker NOSE to keep; its markers are "),
        (["--subject", "gone.yaml"], "gone.yaml"),
    ],
)
def test_option_that_does_not_fit_is_named(mocapfix, brief, tmp_path, options, sentence):
    check_refused(mocapfix("clean", brief.path, "--out", tmp_path / "out", *options), "", re.escape(sentence))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "text", ["", "{", "bones: 7", "- a\n- b", "marker_set: cmu41\nframes: -1", "\x00\x01", "marker_set: [cmu41"], ids=repr
)
def test_corrupt_subject_is_named(mocapfix, brief, tmp_path, text):
    subject = tmp_path / "corrupt.yaml"
    subject.write_text(text, encoding="utf-8")
    check_refused(mocapfix("clean", brief.path, "--out", tmp_path / "out", "--subject", subject), "corrupt.yaml", "")
    assert [path.name for path in tmp_path.iterdir()] == ["corrupt.yaml"]


def test_unwritable_outputs_are_named(mocapfix, brief, tmp_path):
    taken = tmp_path / "taken"
    taken.write_text("a file", encoding="utf-8")
    for where in (taken, taken / "deeper"):
        status = mocapfix("clean", brief.path, "--subject", brief.subject, "--out", where)
        check_refused(status, where.name, "the folder cannot be created .*; choose another (folder )?with --out")
    check_refused(mocapfix("demo", "--out", taken), "taken", "the folder cannot be created")
    missing = tmp_path / "gone" / "person.yaml"
    check_refused(mocapfix("calibrate", brief.path, "-o", missing), "person.yaml", "cannot be written")
    assert [path.name for path in tmp_path.iterdir()] == ["taken"]
    assert taken.read_text(encoding="utf-8") == "a file"


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="folders cannot be locked for this user")
def test_locked_folder_is_named(mocapfix, brief, tmp_path):
    locked = tmp_path / "locked"
    locked.mkdir(mode=0o500)
    check_refused(mocapfix("clean", brief.path, "--subject", brief.subject, "--out", locked), "brief.c3d", "cannot be written")
    assert list(locked.iterdir()) == []


def check_refused(done, name, sentence):
    """Check for one message on standard error that names the file and the remedy, an empty standard output, and status 1.

    The line about the first compilation on a machine may precede the message: "two markers" are refused by a kernel's stage.
    """
    status, out, err = done
    err = "".join(line for line in err.splitlines(keepends=True) if not line.startswith(COMPILATION_MESSAGE))
    assert (status, out) == (1, "")
    assert name in err
    assert re.search(sentence, err)
    assert "Traceback" not in err
    assert len(err.strip().splitlines()) == 1
    assert err.strip().endswith((".", "?"))
