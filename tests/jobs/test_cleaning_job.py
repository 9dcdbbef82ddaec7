import re

import pytest

from mocapfix.errors import SceneError
from mocapfix.files import shipped
from mocapfix.options import FillOptions
from mocapfix.jobs import cleaning_job
from mocapfix.options import OutputOptions

SHIPPED = shipped.find_shipped_folder("scenes")


@pytest.fixture
def scene(tmp_path):
    """Writes a scene with one take and these lines more; -> its path."""

    def write(lines: str, takes: str = "takes: [a.c3d]"):
        path = tmp_path / "mine.yaml"
        path.write_text(f"kind: clean\ntitle: mine\n{takes}\n{lines}\n", encoding="utf-8")
        return path

    return write


def test_what_is_left_out_is_as_the_command_line_has_it(scene):
    said = cleaning_job.read_cleaning_job(scene(""))
    assert said.fill_options == FillOptions()
    assert said.output_options == OutputOptions()
    assert (said.prior.name, said.start) == (DEFAULT_PRIOR_NAME, DEFAULT_INIT_METHOD)


def test_the_session_that_ships_shows_every_key_as_it_is_when_left_out(scene):
    session, bare = cleaning_job.read_cleaning_job(SHIPPED / "session.yaml"), cleaning_job.read_cleaning_job(scene(""))
    assert session.model_copy(update={"title": "mine", "takes": bare.takes, "subject": None}) == bare
    written = shipped.read_yaml(SHIPPED / "session.yaml")
    assert set(written) == set(cleaning_job.CleaningJob.model_fields)
    for key in ("volume", "prior", "fill", "write"):
        assert set(written[key]) == set(type(getattr(bare, key)).model_fields)


def test_what_may_be_touched_is_said_in_the_units_of_people(scene):
    said = cleaning_job.read_cleaning_job(scene("fill: {limit_mm: 60, max_gap: 2, keep: [LFIN], frames: [10, 90], refill: true}"))
    assert said.fill_options == FillOptions(2.0, ("LFIN",), (10, 90), 0.06, True)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ("fill: {only: [gap, flaw]}", "fill.only.1: must be one of gap, spike"),
        ("volume: {up: W}", "volume.up: "),
        ("volume: {floor: high}", "volume.floor: "),
        ("prior: {scale: 0}", "prior.scale: "),
        ("start: middle", "start: must be one of hybrik-x"),
        ("subject: {calibrate: []}", "subject: must be a subject file, or say calibrate"),
        ("subject: {calibrate: [a.c3d], file: jim.yaml}", "subject: must be a subject file, or say calibrate"),
        ("colour: red", "colour: "),
        ("write: {also: [avi]}", "write: There is no kind of file 'avi'"),
        ("write: {bvh_for: [paint]}", "write: There is no rig 'paint'"),
        ("write: {fps: 100000}", "write: Frames a second must be"),
    ],
)
def test_a_wrong_key_is_told_by_its_path(scene, lines, message):
    path = scene(lines)
    with pytest.raises(SceneError, match=re.escape(f"{path}: {message}")):
        cleaning_job.read_cleaning_job(path)


@pytest.mark.parametrize(
    ("takes", "message"),
    [
        ("takes: []", "takes: "),
        ("takes: [{}]", "takes.0: must be a file, or say compose"),
        ("takes: [a.c3d, {compose: sub/b.c3d}]", "takes.1.compose: must be the name of a C3D file, without a folder"),
        ("takes: [a.c3d, {compose: b.c3d, sed: 1}]", "takes.1.sed: "),
        ("", "takes: "),
    ],
)
def test_wrong_takes_are_told_by_their_place(scene, takes, message):
    path = scene("", takes)
    with pytest.raises(SceneError, match=re.escape(f"{path}: {message}")):
        cleaning_job.read_cleaning_job(path)


def test_wildcards_find_files_beside_the_scene_each_once_in_order(tmp_path):
    for name in ("b.c3d", "a.c3d", "sub/c.c3d", "rom.c3d"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    found = cleaning_job.expand_paths(tmp_path / "scene.yaml", ["rom.c3d", "*.c3d", "sub/*", "gone.c3d"], "takes")
    assert [path.relative_to(tmp_path).as_posix() for path in found] == ["rom.c3d", "a.c3d", "b.c3d", "sub/c.c3d", "gone.c3d"]


def test_a_wildcard_that_finds_nothing_is_told(tmp_path):
    with pytest.raises(SceneError, match=r"takes: no file in .* is called '\*\.trc'"):
        cleaning_job.expand_paths(tmp_path / "scene.yaml", ["a.c3d", "*.trc"], "takes")
