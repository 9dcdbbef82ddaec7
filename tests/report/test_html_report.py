"""The HTML report: its texts, tables, figures and time line, and that file contents are escaped."""

import json
import re
from dataclasses import dataclass, replace
from html.parser import HTMLParser

import numpy as np
import pytest

from mocapfix.errors import WriteError
from mocapfix.model import changes
from mocapfix.model.changes import serialize_changes
from mocapfix.model.faults import Fault, Faults, Fragment
from mocapfix.report.html_report import write_html_report
from mocapfix.report.stick_figures import fit_figure_view

VOID_TAGS = {"meta", "br", "img", "link", "input"}


class Page(HTMLParser):
    """A well-formed page: its tags, their attributes, and the visible text."""

    def __init__(self, path):
        super().__init__()
        self.source = path.read_text(encoding="utf-8")
        self.open, self.tags, self.words, self.scripts = [], [], [], []
        self.feed(self.source)
        assert self.open == []
        self.text = " ".join(" ".join(self.words).split())

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID_TAGS:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if "script" in self.open:
            self.scripts.append(data)
        elif "style" not in self.open:
            self.words.append(data)

    def find_attributes(self, tag, css_class):
        return [attrs for each, attrs in self.tags if each == tag and attrs.get("class") == css_class]

    def cut_section(self, start, end):
        return self.text.partition(start)[2].partition(end)[0]


def write_page(scene, tmp_path, report=None, target=None, **fields):
    comparison = scene.replace_comparison(**fields).comparison
    write_html_report(target or tmp_path / "walk.html", report or scene.report, comparison)
    return Page(tmp_path / "walk.html")


def test_the_summary_lists_faults_changes_and_missing_samples(scene, tmp_path):
    text = write_page(scene, tmp_path).text
    kinds = "1 label swap, 1 fragment under another label, 1 marker shift, 3 gaps, 1 spike and 1 burst of jitter"
    assert f"9 of 31 markers have faults: {kinds}." in text
    assert f"{(~scene.comparison.input_take.visible).sum()} of 7,440 samples" in text
    done = "60 samples were relabelled, 1 sample was replaced as faulty and 60 samples were missing and are filled"
    assert f"{done}; every other sample is as measured." in text
    assert "The body's mean distance from the markers is 3.2 mm (95th percentile 7.4 mm)." in text
    assert f"{(~scene.comparison.cleaned_take.visible).sum()} samples still missing: <b>&\"'." in text
    assert "Unchanged faults: 1 burst of jitter." in text
    assert "Lost by the solved body although their markers are seen: left arm (3 frames)." in text
    assert "The <hand> was hidden." in text
    assert "Look at M07 & its neighbours." in text


def test_every_change_is_listed_with_the_files_frame_numbers(scene, tmp_path):
    text = write_page(scene, tmp_path).text.partition("Changes by events")[2]
    assert text.startswith(" 6 changes in ")
    estimated = "Estimated, mostly from the body."
    assert f"gap-M03-151 M03 151–200 M03 is missing for 0.42 s. {estimated} 50 → 0 – → 0.0 17.3 made" in text
    assert f"spike-M05-171 M05 171 M05 is 300 mm off its trajectory. {estimated} 300.0 → 0.0 17.3 made" in text
    assert f"161–180 <b> is missing. {estimated} 20 → 10 – → 0.0 17.3 made" in text
    assert "swap-M10-251 M10, M11 251–270 The labels of M10 and M11 are swapped." in text
    markers = scene.comparison.cleaned_take.markers
    distance_mm = 1e3 * np.linalg.norm(markers[150, 10] - markers[150, 11])
    assert f"{distance_mm:,.1f} → 0.0 made" in text
    assert "M12, *1<i> 121–140 *1<i> continues M12." in text
    assert "moved-M20-311 M20 311–340 M20 shifts by 30 mm." in text
    assert "30.0 → 30.0 made" in text


def test_changes_at_one_time_of_neighbouring_markers_are_one_event(scene, tmp_path):
    page, events = write_page(scene, tmp_path), scene.comparison.events
    shown = [part.partition("</details>")[0] for part in page.source.split('<details class="event">')[1:]]
    assert len(shown) == len(events)
    for text, event in zip(shown, events, strict=True):
        assert set(re.findall(r"<td>([a-z]+-\S+-\d+)</td>", text)) == {
            change.id.replace("<b>&\"'", "&lt;b&gt;&amp;&#34;&#39;") for change in event
        }
    worst = [max(change.predicted_mm or 0.0 for change in event) for event in events]
    assert worst == sorted(worst, reverse=True)


@dataclass(frozen=True)
class Picture:
    """A stick figure: its box (left, top, width and height) and its paths by class."""

    box: tuple[float, ...]
    paths: dict[str, str]

    def contains(self, x, y):
        left, top, width, height = self.box
        return left < x < left + width and top < y < top + height


def find_pictures(page):
    """Return the stick figures before and after."""
    parts = re.findall(r'<svg class="figure" viewBox="([^"]+)".*?</svg>', page.source)
    svgs = re.findall(r'<svg class="figure".*?</svg>', page.source)
    paths = [dict(re.findall(r'<path class="(\w+)" d="([^"]*)"', svg)) for svg in svgs]
    return [
        Picture(tuple(map(float, box.split())), {name: path for name, path in each.items() if name != "floor"})
        for box, each in zip(parts, paths, strict=True)
    ]


def find_dots(path):
    return [(float(x), float(y)) for x, y in re.findall(r"M([-\d.]+) ([-\d.]+)h0", path)]


def make_uncertain(scene, sd_m):
    """Return the scene with another standard deviation of the samples of the spike, and of the last frame of the gap of M03."""
    comparison = scene.comparison
    sample_sd = comparison.cleaned_take.sample_sd.copy()
    sample_sd[70, 5], sample_sd[99, 3] = sd_m, 0.011
    after = comparison.cleaned_take.replace_markers(comparison.cleaned_take.markers, sample_sd)
    made = changes.build_changes(
        comparison.input_take, comparison.relabelled_take, after, comparison.faults.items, None, np.full(sample_sd.shape, "")
    )
    return scene.replace_comparison(cleaned_take=after, changes=tuple(change for change, _ in made))


def test_a_change_above_the_limit_is_not_called_accepted(scene, tmp_path):
    for sd_m, is_reliable in ((0.0599, True), (0.0601, False)):  # the limit is 60 mm per axis
        page = write_page(make_uncertain(scene, sd_m), tmp_path)
        (row,) = re.findall(r"<td>spike-M05-171</td>.*?</tr>", page.source, re.DOTALL)
        assert ("<td>made</td>" in row, "<td>made, unreliable: review it</td>" in row) == (is_reliable, not is_reliable)


def test_the_worst_prediction_is_one_number(scene, tmp_path):
    uncertain = make_uncertain(scene, 0.05)
    page, number = write_page(uncertain, tmp_path), f"{50 * 3**0.5:.1f}"
    assert uncertain.comparison.worst_moment == (70, uncertain.comparison.changes[1])
    assert f"{number} mm predicted error of the worst change" in page.text
    assert f"spike of M05, frame 171, event 1, predicted error {number} mm" in page.text
    assert f"1 spike: M05 171 {number} 1" in page.text
    assert f"Predicted error {number} mm." in page.text
    assert str(uncertain.comparison.changes[1].predicted_mm) == number


def test_the_worst_moment_is_the_least_certain_sample_of_the_worst_change(scene):
    comparison = make_uncertain(scene, 0.001).comparison  # the gap of M03 is the worst, since its last sample is
    assert comparison.worst_moment == (99, comparison.changes[0])
    rejected = replace(comparison, changes=(replace(comparison.changes[0], decision="reject"), *comparison.changes[1:]))
    assert rejected.worst_moment[0] == 60  # in the other gap


def test_the_frames_around_the_worst_moment_are_played(scene, tmp_path):
    uncertain = make_uncertain(scene, 0.05)
    page = write_page(uncertain, tmp_path)
    data = json.loads(page.scripts[0])
    assert data["rate"] == 30.0
    assert data["numbers"] == list(range(101 + 2, 101 + 191, 4))  # at 120 Hz, one second before and after frame 70
    assert data["numbers"][data["index"]] == 171
    pictures = find_pictures(page)
    for number, paths in zip(data["numbers"], data["paths"], strict=True):
        states = uncertain.comparison.sample_states[number - 101]
        before, after = paths
        assert after["filled"].count("M") == (states == 1).sum()
        assert before["measured"].count("M") + before["suspect"].count("M") + before["relabelled"].count("M") == (
            uncertain.comparison.input_take.visible[number - 101].sum()
        )
        assert after["ring"].count("M") == 1
        assert bool(after["bones"]) > bool(before["bones"])
        for x, y in find_dots(after["measured"]):
            assert pictures[1].contains(x, y)
    for picture, paths in zip(pictures, data["paths"][data["index"]], strict=True):  # what stands there without the script
        assert picture.paths == paths
    assert "prefers-reduced-motion" in page.scripts[1]


def test_filled_gaps_of_a_lost_segment_are_drawn_as_filled(scene, tmp_path):
    lost = Fault("segment lost", 3, 40, 109, 0.5, "The segment is lost.", other_markers=(5, 29))
    page = write_page(scene, tmp_path, faults=scene.comparison.faults.add_faults([lost]))
    rows = {row.partition("</b>")[0]: row for row in page.source.split('<div class="row"><b>')[1:]}
    filled, left = r'class="missing" style="left:([\d.]+)%;width:([\d.]+)%', r'class="missing left" style="left:([\d.]+)%;width'
    assert set(re.findall(filled, rows["M03"])) == {("20.833", "20.833")}  # the 50 frames of its gap from frame 50 on, of 240
    assert not re.findall(left, rows["M03"])
    assert not re.findall(left, rows["M05"])  # it is measured
    ends = [re.findall(pattern, rows["&lt;b&gt;&amp;&#34;&#39;"])[0] for pattern in (filled, left)]
    assert ends == [("25.000", "4.167"), "29.167"]  # half of its gap is filled, half is left


def test_the_page_gives_the_command_that_reverts_a_change(scene, tmp_path):
    text = write_page(scene, tmp_path).text
    assert "mocapfix clean 'walk <1>.c3d' --changes 'walk <1>.changes.yaml' --overwrite" in text
    assert "“keep”: leave the samples as they are and use them in the solve" in text


def test_unchanged_faults_are_listed(scene, tmp_path):
    text = write_page(scene, tmp_path).text.rpartition("Unchanged faults")[2].partition("Residuals by")[0]
    assert text.strip().startswith("1 fault ")
    assert text.strip().endswith("jitter M07 221–240 10 mm M07 jitters.")


def test_a_rejected_change_has_no_figure(scene, tmp_path):
    declined = tuple(replace(each, decision="reject" if each.kind == "spike" else "accept") for each in scene.comparison.changes)
    report = scene.report | {"changes": serialize_changes(declined)}
    page = write_page(scene, tmp_path, changes=declined, report=report)
    assert "Declined in review: 1 rejected." in page.text
    assert len(page.find_attributes("svg", "change")) == 5
    assert "spike: M05" not in page.cut_section("Largest changes", "Distance of")
    assert "spike-M05-171 M05 171 M05 is 300 mm off its trajectory. Not applied. 300.0 → 0.0 17.3 rejected" in page.text


def test_bars_are_at_the_frames_of_the_faults(scene, tmp_path):
    page = write_page(scene, tmp_path)

    def find_styles(css_class):
        return [bar["style"] for bar in page.find_attributes("i", css_class) if "title" in bar]

    assert find_styles("missing") == ["left:20.833%;width:20.833%", "left:25.000%;width:4.167%"]
    assert find_styles("faulty") == ["left:29.167%;width:0.417%"]
    assert find_styles("missing left") == ["left:29.167%;width:4.167%", "left:0.000%;width:100.000%"]
    assert find_styles("faulty left") == ["left:50.000%;width:8.333%"]
    swap, fragment = "left:62.500%;width:8.333%", "left:8.333%;width:8.333%"
    assert find_styles("label") == [swap, swap, fragment, fragment]  # both markers of the swap; M12 and its donor
    assert find_styles("place") == ["left:87.500%;width:12.500%"]
    assert "Joined to M12." in [bar.get("title") for bar in page.find_attributes("i", "label")]
    assert "*1<i>" in page.cut_section("Faults over time", "Numbers")


def test_long_unchanged_faults_are_drawn_below_short_ones_and_outlined(scene, tmp_path):
    noise = Fault("noise", 5, 0, 239, 0.01, "M05 is noisy.")
    page = write_page(scene, tmp_path, faults=scene.comparison.faults.add_faults([noise]))
    row = page.source.partition("<b>M05</b>")[2].partition("</div>")[0]
    assert re.findall(r'class="([\w ]+)" style', row) == ["faulty left", "faulty left", "faulty"]  # before and after the spike


def test_unmatched_trajectories_are_listed_but_are_not_faults_of_markers(scene, tmp_path):
    other = Fragment("fragment", 31, 90, 99, np.nan, "*1<i> does not move.", donor=31)
    double = Fragment("fragment", 8, 100, 119, 0.01, "*1<i> duplicates M08.", donor=31, relation="doubles")
    page = write_page(scene, tmp_path, faults=scene.comparison.faults.add_faults([other, double]))
    assert "9 of 31 markers have faults" in page.text
    assert "1 unlabelled trajectory matches no marker." in page.text
    assert "fragment *1<i> 191–200 – *1<i> does not move." in page.text
    timeline = page.cut_section("Faults over time", "Numbers")
    assert "M08" not in timeline
    assert timeline.count("*1<i>") == 1


def test_a_figure_that_is_cut_says_so(scene, tmp_path):
    assert "Only the beginning is shown." not in write_page(scene, tmp_path).text
    slow = {name: replace(getattr(scene.comparison, name), rate=2.0) for name in ("input_take", "cleaned_take")}
    assert write_page(scene, tmp_path, **slow).text.count("Only the beginning is shown.") == 1  # the swap


def test_near_bars_are_merged(scene, tmp_path):
    faults = Faults(tuple(Fault("jitter", 9, t, t, 0.01, f"At {t}.") for t in (10, 11, 100)))
    page = write_page(scene, tmp_path, faults=faults, changes=())
    bars = [bar for bar in page.find_attributes("i", "faulty left") if "title" in bar]
    assert [(bar["title"], bar["style"]) for bar in bars] == [
        ("At 10. And 1 more nearby.", "left:4.167%;width:0.833%"),
        ("At 100.", "left:41.667%;width:0.417%"),
    ]


def test_file_contents_are_escaped_and_nothing_is_loaded_from_elsewhere(scene, tmp_path):
    page = write_page(scene, tmp_path)
    assert "walk <1>.c3d" in page.text
    assert "<1>" not in page.source
    assert "<hand>" not in page.source
    for tag, attrs in page.tags:
        assert tag not in {"link", "img", "iframe", "hand"}
        assert not {"src", "href"} & attrs.keys()
    assert "url(" not in page.source
    assert "http" not in page.source


@pytest.mark.parametrize("is_predicted", [True, False])
def test_the_worst_moment_is_shown_before_and_after(scene, tmp_path, is_predicted):
    scene = make_uncertain(scene, 0.05)
    if not is_predicted:  # only in frame 70 the spike coincides with a filled gap
        unknown = tuple(replace(change, predicted_mm=None) for change in scene.comparison.changes)
        scene = scene.replace_comparison(changes=unknown)
    page = write_page(scene, tmp_path)
    assert ("It has the most corrections." in page.text) != is_predicted
    assert "Frame 171, 0.58 s after the first." in page.text
    before, after = find_pictures(page)
    assert sum(map(len, map(find_dots, before.paths.values()))) == scene.comparison.input_take.visible[70].sum() + is_predicted
    assert len(find_dots(before.paths["suspect"])) == 1
    shown = sum(len(find_dots(path)) for name, path in after.paths.items() if name not in ("bones", "ring"))
    assert shown == scene.comparison.cleaned_take.visible[70].sum()
    assert len(find_dots(after.paths["replaced"])) == 1
    assert len(find_dots(after.paths["filled"])) == 1


def test_the_body_faces_the_viewer_in_the_middle_of_the_figure(scene):
    body = scene.comparison.joint_position_world[50]
    view = fit_figure_view(scene.comparison, 50, body)
    left, top, width, height = view.box_cm
    places = view.project_points(body)
    head, foot, right, left_hand = (
        places[scene.comparison.skeleton.find_joint(name)] for name in ("Head", "LeftFoot", "RightHand", "LeftHand")
    )
    assert head[1] < foot[1]  # y points down in an SVG
    assert left < right[0] < left + width / 2 < left_hand[0] < left + width
    assert ((top < places[:, 1]) & (places[:, 1] < top + height)).all()


def test_the_residual_curve_is_interrupted_at_unknown_values(scene, tmp_path):
    residual_m = np.full((240, 31), 0.004)
    residual_m[100:120] = np.nan
    page = write_page(scene, tmp_path, residual_m=residual_m)
    (curve,) = page.find_attributes("path", "middle")
    assert curve["d"].count("M") == 2
    assert curve["d"].count("L") == 99 + 119
    assert set(re.findall(r" ([\d.]+)", curve["d"])) == {"0.200"}  # 4 of 5 mm
    assert "5 mm" in page.text


def test_residuals_are_sorted_and_unknown_ones_are_left_out(scene, tmp_path):
    text = write_page(scene, tmp_path).text
    assert text.index("M28 30.0 / 31.0") < text.index("M01 3.0 / 4.0")
    assert text.index("LeftHand 12.0 / 21.0") < text.index("LeftFoot 6.0 / 9.0")
    assert "never nan" not in text
    assert "200 solved: well 40 guessed: too few" in text
    assert "LeftLeg 41.8 cm" in text
    assert "LHipJoint" not in text


def test_a_take_without_a_body(scene, tmp_path):
    report = scene.report | {"subject": None, "solve": None, "take": scene.report["take"] | {"marker_set": None}}
    page = write_page(scene, tmp_path, report=report, skeleton=None, joint_position_world=None, residual_m=None)
    assert "No body was used" in page.text
    assert "None" not in page.text
    assert "Bone lengths" not in page.text
    assert not any(picture.paths["bones"] for picture in find_pictures(page))


def test_a_take_without_faults(scene, tmp_path):
    fill = {
        "missing_before": 0,
        "filled": 0,
        "replaced": 0,
        "relabelled": 0,
        "left_empty": 0,
        "unfilled": [],
        "left_by_marker": [],
    }
    complete = scene.comparison.input_take.replace_markers(scene.comparison.joint_position_world)
    takes = {"input_take": complete, "relabelled_take": complete, "cleaned_take": complete}
    report = scene.report | {"fill": fill, "changes": []}
    page = write_page(scene, tmp_path, report=report, **takes, faults=Faults(), changes=())
    assert "No faults: every marker is visible in every frame." in page.text
    assert "No changes: all samples are as measured." in page.text
    assert "No missing samples." in page.text
    assert "Changes by events" not in page.text
    assert "after the first. Nothing was corrected." in page.text
    assert "Unchanged faults" not in page.text
    assert not page.find_attributes("svg", "change")


def test_a_take_without_any_sample_has_a_page(scene, tmp_path):
    empty = scene.comparison.input_take.replace_markers(np.full_like(scene.comparison.input_take.markers, np.nan))
    takes = {"input_take": empty, "relabelled_take": empty, "cleaned_take": empty}
    body = {"skeleton": None, "joint_position_world": None, "residual_m": np.full((240, 31), np.nan)}
    page = write_page(scene, tmp_path, **takes, **body)
    assert "31 left empty" in page.text
    assert not re.search(r"\bnan\b", page.source)


@pytest.mark.parametrize("count", [300, 6000])
def test_the_page_of_a_take_with_many_faults_stays_small(scene, tmp_path, count):
    per_marker = count // 30
    items = tuple(
        Fault("gap", m, 8 * n, 8 * n + 3, 0.1, f"M{m:02d} is missing for 0.03 s and moves.")
        for m in range(30)
        for n in range(per_marker)
    )
    cleaned_markers, markers = np.zeros((8 * per_marker, 31, 3)), np.zeros((8 * per_marker, 31, 3))
    for fault in items:
        markers[fault.first : fault.last + 1, fault.marker] = np.nan
    before = replace(scene.comparison.input_take, markers=markers, unlabelled=None)
    after = before.replace_markers(cleaned_markers, np.where(np.isnan(markers[..., 0]), 0.01, np.nan))
    methods = np.full((8 * per_marker, 31), "the body", object)
    made = tuple(change for change, _ in changes.build_changes(before, before, after, items, None, methods))
    takes = {"input_take": before, "relabelled_take": before, "cleaned_take": after, "faults": Faults(items), "changes": made}
    page = write_page(scene, tmp_path, **takes, skeleton=None, joint_position_world=None, residual_m=None)
    assert len(page.source.encode()) < 1_500_000
    assert f"{count:,} changes in " in page.text
    assert ("And 4,980 more in the JSON report." in page.text) == (count > 1000)
    assert len(page.find_attributes("svg", "change")) == 12
    open_lists = [attrs for tag, attrs in page.tags if tag == "details" and "open" in attrs]
    assert len(open_lists) == 2 + (count == 300)  # those of what is left empty, by marker and by interval, and that of 10 events


def test_a_missing_folder_is_named(scene, tmp_path):
    with pytest.raises(WriteError, match=r"nowhere.*walk\.html"):
        write_page(scene, tmp_path, target=tmp_path / "nowhere" / "walk.html")
