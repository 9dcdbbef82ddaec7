"""The session page: failures first, everything escaped, links that lead to the files, and no network."""

import re
from html.parser import HTMLParser
from pathlib import Path
from tempfile import TemporaryDirectory
from urllib.parse import unquote

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from markupsafe import escape

from mocapfix.batch.records import PersonEntry, SessionPeople, TakeRecord, write_people_file
from mocapfix.batch.session_page import (
    build_session_page,
    check_picture,
    describe_session,
    quote_address,
    select_subject_outputs,
    write_session_page,
)
from mocapfix.errors import WriteError
from tests.batch.session_records import PICTURE, build_done, build_failed, build_figures, names, take_records

KNOWN_TAGS = {
    "html", "head", "meta", "title", "style", "body", "main", "header", "p", "h1", "h2", "div", "b", "small", "a", "table",
    "label", "thead", "tbody", "tr", "th", "td", "details", "summary", "svg", "path", "input", "select", "option", "span",
    "button", "script", "noscript",
}  # fmt: skip


class Outline(HTMLParser):
    """The tags of a page with their attributes, and the texts of its table cells."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.source = path.read_text(encoding="utf-8")
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.cells: list[str] = []
        self.feed(self.source)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag in ("td", "th"):
            self.cells.append("")

    def handle_data(self, data):
        if self.cells:
            self.cells[-1] += data

    @property
    def addresses(self) -> list[str]:
        return [str(attrs["href"]) for tag, attrs in self.tags if tag == "a"]


def test_failures_are_on_top_with_their_sentence(tmp_path: Path) -> None:
    records = [build_done("a.c3d"), build_failed("z.c3d", "z.c3d: is no C3D file."), build_failed("b.c3d", "b hangs.", "timeout")]
    page = build_session_page(records)
    assert [(row.take, row.reason, row.error) for row in page["failures"]] == [
        ("b.c3d", "timeout", "b hangs."),
        ("z.c3d", "error", "z.c3d: is no C3D file."),
    ]
    assert [row.take for row in page["rows"]] == ["b.c3d", "z.c3d", "a.c3d"]
    assert page["failure_text"] == "2 failed: 1 error and 1 timeout"
    text = write_session_page(tmp_path, records).read_text(encoding="utf-8")
    assert text.index("z.c3d: is no C3D file.") < text.index('id="takes"')
    assert text.index("Failed takes") < text.index("<h2>Takes</h2>")


@pytest.mark.parametrize(("title", "shown"), [("Monday <1>", "Monday &lt;1&gt;"), ("", "cleaned")])
def test_title_is_that_of_the_session_or_the_name_of_the_folder(tmp_path: Path, title: str, shown: str) -> None:
    folder = tmp_path / "cleaned"
    folder.mkdir()
    text = write_session_page(folder, [build_done("a.c3d")], title=title).read_text(encoding="utf-8")
    assert f"<h1>{shown}</h1>" in text


def test_totals_are_those_of_all_takes() -> None:
    page = build_session_page([build_done("a.c3d"), build_done("b.c3d", "Jim", "Ann"), build_failed("c.c3d")])
    facts = {text: value for value, text in page["facts"]}
    assert facts["of 3 takes done"] == "2"
    assert facts["failed"] == "1"
    assert facts["of motion, h:min:s"] == "0:00:20"
    assert facts["samples filled"] == "7,200"
    assert facts["of the samples missing before"] == "5.0 %"
    assert facts["of computation, h:min:s"] == "0:00:09"


def test_page_needs_no_network_and_its_script_is_the_only_one_allowed(tmp_path: Path) -> None:
    outline = Outline(write_session_page(tmp_path, [build_done("a/b.c3d")]))
    assert not re.search(r"https?:|//[a-z]|url\(|@import", outline.source.replace('"use strict"', ""))
    assert [tag for tag, _ in outline.tags].count("script") == 1
    policy = next(str(attrs["content"]) for tag, attrs in outline.tags if tag == "meta" and "http-equiv" in attrs)
    assert "default-src 'none'" in policy
    assert re.search(r"script-src 'sha256-[\w+/]{43}='", policy)


def test_headers_have_a_scope_and_the_tools_wait_for_the_script(tmp_path: Path) -> None:
    outline = Outline(write_session_page(tmp_path, [build_done("a.c3d"), build_failed("b.c3d")]))
    assert all(attrs.get("scope") in ("col", "row") for tag, attrs in outline.tags if tag == "th")
    assert next(attrs for _, attrs in outline.tags if attrs.get("id") == "tools").get("hidden", "no") is None
    heads = [attrs for tag, attrs in outline.tags if tag == "th"][-15:]
    assert [n for n, attrs in enumerate(heads) if "data-unsorted" in attrs] == [13, 14]


def test_links_lead_to_the_files_of_the_subject(tmp_path: Path) -> None:
    record = build_done("day 1/what?#100%:&.c3d", "Jim", "Jim.2")
    outline = Outline(write_session_page(tmp_path, [record]))
    paths = {unquote(address) for address in outline.addresses}
    assert paths == {"summary.csv", "summary.parquet", *record.outputs.values()}
    assert not any(set(address) & set("?#:& ") for address in outline.addresses)
    assert set(select_subject_outputs(record, "Jim")) == {"c3d", "Jim.bvh", "Jim.report.html"}
    assert set(select_subject_outputs(record, "Jim.2")) == {"c3d", "Jim.2.bvh", "Jim.2.report.html"}
    (first, second) = (row.report for row in build_session_page([record])["rows"])
    assert first.endswith(".Jim.report.html")
    assert second.endswith(".Jim.2.report.html")


@given(names)
def test_addresses_are_relative_and_can_be_unquoted(path: str) -> None:
    address = quote_address(path)
    assert unquote(address) == path
    assert re.fullmatch(r"[\w.~/%-]+", address)


@given(st.lists(take_records(), min_size=1, max_size=3))
@settings(max_examples=30, deadline=None)
def test_any_text_is_escaped(records: list[TakeRecord]) -> None:
    with TemporaryDirectory() as folder:
        outline = Outline(write_session_page(Path(folder), records))
    assert {tag for tag, _ in outline.tags} <= KNOWN_TAGS
    assert not any(name.startswith("on") for _, attrs in outline.tags for name in attrs)
    for record in records:
        assert str(escape(record.take)).replace("\r\n", "\n") in outline.source.replace("\r\n", "\n") or "\r" in record.take


def test_names_that_look_like_html_are_shown(tmp_path: Path) -> None:
    name = """</td><script>alert("1")</script><img src=x onerror='a'>&amp;.c3d"""
    outline = Outline(write_session_page(tmp_path, [build_failed(name, f"{name}: is empty.")]))
    assert "img" not in {tag for tag, _ in outline.tags}
    assert [tag for tag, _ in outline.tags].count("script") == 1
    assert any(name in cell for cell in outline.cells)


def test_long_names_can_be_broken(tmp_path: Path) -> None:
    text = write_session_page(tmp_path, [build_done(f"{'x' * 5000}.c3d")]).read_text(encoding="utf-8")
    assert "overflow-wrap: anywhere" in text


@pytest.mark.parametrize(
    "svg",
    ["", "<script>a()</script>", PICTURE.replace("<path", "<path onload='a'"), PICTURE + "<b>", PICTURE.replace(" d=", " x=")],
)
def test_picture_that_mocapfix_does_not_draw_is_left_out(svg: str) -> None:
    assert check_picture(svg) == ""


def test_picture_of_a_cleaned_take_is_shown(tmp_path: Path) -> None:
    assert check_picture(PICTURE) == PICTURE
    assert PICTURE in write_session_page(tmp_path, [build_done("a.c3d")]).read_text(encoding="utf-8")


def test_unknown_figures_are_dashes() -> None:
    unknown = {"worst_predicted_error_mm": None, "residual_mm": None, "sample_count": 0, "missing_before": 0, "fault_counts": {}}
    record = build_done("a.c3d").model_copy(update={"subjects": (build_figures("", **unknown),)})
    (row,) = build_session_page([record])["rows"]
    assert row.numbers[1] == "0.0"
    assert row.numbers[6:8] == ("–", "–")
    assert row.faults == "0"


def test_people_are_listed_with_their_moved_markers(tmp_path: Path) -> None:
    moved = "Marker LFHD lies 31 mm from its usual place in b.c3d."
    jim = PersonEntry(
        name="<Jim>",
        basis="subject prefix",
        takes={"a.c3d": "Jim", "b.c3d": ""},
        subject_file="people/Jim & co.subject.yaml",
        take_files={"b.c3d": "people/Jim.b.subject.yaml"},
        moved_markers=(moved,),
        rejected={"c.c3d": "the thighs are 40 mm longer."},
    )
    write_people_file(tmp_path, SessionPeople(people=(jim,), notes=("Ann & Jim differ.",)))
    outline = Outline(write_session_page(tmp_path, [build_done("a.c3d")]))
    assert "<Jim>" in outline.cells
    assert moved in outline.cells
    assert any("a.c3d (Jim), b.c3d" in cell for cell in outline.cells)
    assert {"people/Jim%20%26%20co.subject.yaml", "people/Jim.b.subject.yaml", "people.yaml"} <= set(outline.addresses)
    assert "Ann &amp; Jim differ." in outline.source
    assert "c.c3d is not of &lt;Jim&gt;: the thighs are 40 mm longer." in outline.source


def test_people_file_that_cannot_be_read_is_a_note(tmp_path: Path) -> None:
    (tmp_path / "people.yaml").write_text("persons: []\n", encoding="utf-8")
    text = write_session_page(tmp_path, [build_done("a.c3d")]).read_text(encoding="utf-8")
    assert "people.yaml: persons: there is no such key" in text


def test_subtitle_has_versions_and_time() -> None:
    records = [build_done("a.c3d", version="0.2.0", finished="2026-11-23T20:05:10+00:00"), build_done("b.c3d", version="0.1.0")]
    assert describe_session(records) == "Cleaned by mocapfix 0.1.0 and 0.2.0, last take finished at 2026-11-23 20:05 UTC."
    assert describe_session([]) == ""


def test_folder_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    with pytest.raises(WriteError):
        write_session_page(tmp_path / "removed", [])


def test_page_of_a_batch_that_runs_loads_itself_again(tmp_path: Path) -> None:
    running, ended = (write_session_page(tmp_path, [build_done("a.c3d")], count).read_text(encoding="utf-8") for count in (2, 0))
    assert '<meta http-equiv="refresh"' in running
    assert "2 takes still to be cleaned" in running
    assert "of 3 takes done" in running
    assert "refresh" not in ended
    assert "still to be cleaned" not in ended
