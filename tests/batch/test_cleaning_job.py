"""Cleaning jobs: defaults, the shipped session, wrong keys, and wildcards."""

import re

import pytest

from mocapfix.batch.job_files import JOB_MODEL, expand_paths, read_cleaning_job
from mocapfix.errors import SceneError
from mocapfix.io import shipped
from mocapfix.options import OPTIONS, CleanOptions, FillOptions

SHIPPED = shipped.find_shipped_folder("scenes")


@pytest.fixture
def write_job(tmp_path):
    """A function that writes a job with one take and further lines, and returns its path."""

    def write(lines: str, takes: str = "takes: [a.c3d]"):
        path = tmp_path / "mine.yaml"
        path.write_text(f"kind: clean\ntitle: mine\n{takes}\n{lines}\n", encoding="utf-8")
        return path

    return write


def test_missing_keys_have_the_default_options(write_job):
    assert read_cleaning_job(write_job("")).options == CleanOptions()


def test_shipped_session_shows_every_key_with_its_default():
    """Those of detection and solver, which few people set, are in the documentation only."""
    assert read_cleaning_job(SHIPPED / "session.yaml").options == CleanOptions()
    session = shipped.read_yaml(SHIPPED / "session.yaml")
    for key in (option.job_key for option in OPTIONS if option.job_key):
        section, _, name = key.rpartition(".")
        assert section in ("detect", "solve") or name in (session[section] if section else session), key
    assert set(session) <= set(JOB_MODEL.model_fields)


def test_lengths_are_in_millimetres(write_job):
    job = read_cleaning_job(write_job("fill: {limit_mm: 60, max_gap: 2, keep: [LFIN], frames: [10, 90], refill: true}"))
    assert job.options.fill == FillOptions(max_gap_s=2.0, keep=("LFIN",), frames=(10, 90), max_sd_m=0.06, refill=True)


def test_purpose_of_a_job_sets_what_it_does_not_give(write_job):
    for lines in ("purpose: lab", "purpose: lab\nfill: {limit_mm: null}\ncontacts: {feet: null}"):
        assert read_cleaning_job(write_job(lines)).options == CleanOptions().change(purpose="lab")
    options = read_cleaning_job(write_job("purpose: lab\nfill: {limit_mm: 250}\ncontacts: {feet: soft}")).options
    assert (options.fill.max_sd_m, options.fill.max_end_sd_m, options.contacts.feet) == (0.25, 0.0, "soft")


def test_expert_options_can_be_set(write_job):
    job = read_cleaning_job(write_job("solve: {robust_scales_mm: [100, 40], marker_sd_mm: 12}\ndetect: {max_rounds: 1}"))
    assert job.options == CleanOptions().change(robust_scales_m=(0.1, 0.04), marker_sd_m=0.012, max_rounds=1)


def test_marker_set_beside_the_job_takes_precedence(write_job, tmp_path):
    path = write_job("marker_set: cmu41")
    assert read_cleaning_job(path).options.subject.marker_set == "cmu41"
    (tmp_path / "cmu41").touch()
    assert read_cleaning_job(path).options.subject.marker_set == tmp_path / "cmu41"


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ("fill: {only: [gap, flaw]}", "fill.only: must be one of gap, spike"),
        ("volume: {up: W}", "volume.up: "),
        ("volume: {floor: high}", "volume.floor: "),
        ("prior: {scale: 0}", "prior.scale: must be greater than 0"),
        ("start: middle", "start: must be one of hybrik-x"),
        ("subject: {calibrate: []}", "subject: must have either file or calibrate"),
        ("subject: {calibrate: [a.c3d], file: jim.yaml}", "subject: must have either file or calibrate"),
        ("colour: red", "colour: "),
        ("solve: {marker_sd_mm: -1}", "solve.marker_sd_mm: must be greater than 0 mm and finite, not -1"),
        ("write: {also: [avi]}", "write.also: must be one of gltf"),
        ("write: {bvh_for: [paint]}", "write: There is no rig 'paint'"),
        ("write: {loop: true}", "write.loop: is for the motion of a character; name a character too."),
        ("write: {fps: 100000}", "write.fps: must be at least 5 Hz and at most 1000 Hz, not 100000"),
    ],
)
def test_error_names_the_wrong_key(write_job, lines, message):
    path = write_job(lines)
    with pytest.raises(SceneError, match=re.escape(f"{path}: {message}")):
        read_cleaning_job(path)


@pytest.mark.parametrize(
    ("takes", "message"),
    [
        ("takes: []", "takes: "),
        ("takes: [{}]", "takes.0: must have either file or compose"),
        ("takes: [a.c3d, {compose: sub/b.c3d}]", "takes.1.compose: must be the name of a C3D file, without a folder"),
        ("takes: [a.c3d, {compose: b.c3d, sed: 1}]", "takes.1.sed: "),
        ("", "takes: "),
    ],
)
def test_error_names_the_wrong_take(write_job, takes, message):
    path = write_job("", takes)
    with pytest.raises(SceneError, match=re.escape(f"{path}: {message}")):
        read_cleaning_job(path)


def test_wildcards_match_files_beside_the_job_once_and_in_order(tmp_path):
    for name in ("b.c3d", "a.c3d", "sub/c.c3d", "rom.c3d"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    paths = expand_paths(tmp_path / "scene.yaml", ["rom.c3d", "*.c3d", "sub/*", "gone.c3d"], "takes")
    assert [path.relative_to(tmp_path).as_posix() for path in paths] == ["rom.c3d", "a.c3d", "b.c3d", "sub/c.c3d", "gone.c3d"]


def test_wildcard_without_a_match_is_an_error(tmp_path):
    with pytest.raises(SceneError, match=r"takes: no file in .* matches '\*\.trc'"):
        expand_paths(tmp_path / "scene.yaml", ["a.c3d", "*.trc"], "takes")
