import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest

from mocapfix import changes
from mocapfix.errors import WriteError
from mocapfix.faults import Fault, Faults, Fragment
from mocapfix.report import html_report, review_file

VOID = {"meta", "br", "img", "link", "input"}


class Page(HTMLParser):
    """A page that must be well formed: its tags, its attributes, and the text that a reader sees."""

    def __init__(self, path):
        super().__init__()
        self.source = path.read_text(encoding="utf-8")
        self.open, self.tags, self.words = [], [], []
        self.feed(self.source)
        assert self.open == []
        self.text = " ".join(" ".join(self.words).split())

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if "style" not in self.open:
            self.words.append(data)

    def of_class(self, tag, name):
        return [attrs for each, attrs in self.tags if each == tag and attrs.get("class") == name]


def page_of(scene, tmp_path, record=None, target=None, **other):
    html_report(target or tmp_path / "walk.html", record or scene.report, scene.with_(**other).comparison)
    return Page(tmp_path / "walk.html")


def test_it_says_what_was_wrong_done_and_left(scene, tmp_path):
    text = page_of(scene, tmp_path).text
    kinds = "1 exchange of labels, 1 piece under another label, 1 marker knocked to another place, 3 gaps, 1 spike"
    assert f"9 of 31 markers have faults: {kinds} and 1 burst of jitter." in text
    assert f"{(~scene.comparison.before.seen).sum()} of 7,440 samples" in text
    did = "60 samples were put under their own labels, 1 faulty one was replaced and 60 of the missing samples were filled"
    assert f"{did}; every other sample is as it was measured." in text
    assert "3.2 mm from it on average, 95% of them within 7.4 mm" in text
    assert f"{(~scene.comparison.after.seen).sum()} samples are still missing, on <b>&\"'" in text
    assert "Found and kept: 1 burst of jitter." in text
    assert "The <hand> was hidden." in text
    assert "Look at M07 & its neighbours." in text


def test_every_change_is_listed_with_the_files_frames_and_what_was_done(scene, tmp_path):
    text = page_of(scene, tmp_path).text.partition("All changes")[2]
    assert text.startswith(" 6 changes ")
    assert (
        "gap-M03-151 M03 151–200 M03 is not seen for 0.42 s. Estimated, mostly from the body. 50 → 0 – → 0.0 17.3 accept" in text
    )
    assert "spike-M05-171 M05 171 M05 lies 300 mm off its path. Estimated, mostly from the body. 300.0 → 0.0 17.3 accept" in text
    assert "161–180 <b> is not seen. Estimated, mostly from the body. 20 → 10 – → 0.0 17.3 accept" in text
    assert "swap-M10-251 M10, M11 251–270 M10 and M11 have exchanged their labels." in text
    apart = 1e3 * np.linalg.norm(scene.comparison.after.markers[150, 10] - scene.comparison.after.markers[150, 11])
    assert f"Labels exchanged back. {apart:,.1f} → 0.0 accept" in text
    assert "M12, *1<i> 121–140 *1<i> goes on as M12. Samples of *1<i> taken over. 20 → 0 – → 0.0 accept" in text
    place = "Given its new place on the body; its samples stay as measured."
    assert f"moved-M20-311 M20 311–340 M20 is knocked by 30 mm. {place} 30.0 → 30.0 accept" in text


def test_how_somebody_takes_a_change_back_is_said(scene, tmp_path):
    text = page_of(scene, tmp_path).text
    assert "mocapfix clean 'walk <1>.c3d' --changes 'walk <1>.changes.yaml' --overwrite" in text


def test_what_was_found_and_kept_is_listed_apart(scene, tmp_path):
    text = page_of(scene, tmp_path).text.partition("Found, and kept as it was")[2].partition("All changes")[0]
    assert text.strip().startswith("1 fault ")
    assert text.strip().endswith("jitter M07 221–240 10 mm M07 trembles.")


def test_a_change_that_somebody_rejected_has_neither_picture_nor_effect(scene, tmp_path):
    decided = tuple(replace(each, decision="reject" if each.kind == "spike" else "accept") for each in scene.comparison.changes)
    record = scene.report | {"changes": review_file.serialize_changes(decided)}
    page = page_of(scene, tmp_path, changes=decided, record=record)
    assert "Not made, by decision: 1 rejected." in page.text
    assert len(page.of_class("svg", "change")) == 5
    assert "spike: M05" not in page.text
    assert "spike-M05-171 M05 171 M05 lies 300 mm off its path. Not made. 300.0 → 0.0 17.3 reject" in page.text


def test_bars_lie_where_the_faults_are(scene, tmp_path):
    page = page_of(scene, tmp_path)

    def places(name):
        return [bar["style"] for bar in page.of_class("i", name) if "title" in bar]

    assert places("missing") == ["left:20.833%;width:20.833%", "left:25.000%;width:4.167%"]
    assert places("faulty") == ["left:29.167%;width:0.417%"]
    assert places("missing left") == ["left:29.167%;width:4.167%", "left:0.000%;width:100.000%"]
    assert places("faulty left") == ["left:50.000%;width:8.333%"]
    assert places("label") == 2 * ["left:62.500%;width:8.333%"] + 2 * ["left:8.333%;width:8.333%"]  # both swapped; M12, its donor
    assert places("place") == ["left:87.500%;width:12.500%"]
    assert "Taken over by M12." in [bar.get("title") for bar in page.of_class("i", "label")]
    assert "*1<i>" in page.text.partition("Faults over time")[2].partition("Distance of")[0]


def test_what_lasts_is_drawn_below_what_happens_meanwhile_and_outlined_where_nothing_was_done(scene, tmp_path):
    noise = Fault("noise", 5, 0, 239, 0.01, "M05 trembles all along.")
    page = page_of(scene, tmp_path, faults=scene.comparison.faults.add_faults([noise]))
    row = page.source.partition("<b>M05</b>")[2].partition("</div>")[0]
    assert re.findall(r'class="([\w ]+)" style', row) == ["faulty left", "faulty"]


def test_what_bears_no_name_and_is_no_markers_is_told_of_but_is_no_markers_fault(scene, tmp_path):
    other = Fragment("fragment", 31, 90, 99, np.nan, "*1<i> stands still.", donor=31)
    double = Fragment("fragment", 8, 100, 119, 0.01, "*1<i> is M08 a second time.", donor=31, relation="doubles")
    page = page_of(scene, tmp_path, faults=scene.comparison.faults.add_faults([other, double]))
    assert "9 of 31 markers have faults" in page.text
    assert "1 trajectory without a marker’s name continues none." in page.text
    assert "fragment *1<i> 191–200 – *1<i> stands still." in page.text
    assert "M08" not in page.text.partition("Faults over time")[2].partition("Distance of")[0]
    assert page.text.partition("Faults over time")[2].partition("Distance of")[0].count("*1<i>") == 1


def test_a_picture_says_where_it_ends_before_the_change_does(scene, tmp_path):
    assert "Only its beginning is shown." not in page_of(scene, tmp_path).text
    slow = replace(scene.comparison.before, rate=2.0), replace(scene.comparison.after, rate=2.0)
    assert page_of(scene, tmp_path, before=slow[0], after=slow[1]).text.count("Only its beginning is shown.") == 1  # the swap


def test_bars_that_could_not_be_told_apart_are_one(scene, tmp_path):
    many = tuple(Fault("jitter", 9, t, t, 0.01, f"At {t}.") for t in (10, 11, 100))
    page = page_of(scene, tmp_path, faults=Faults(many), changes=())
    bars = [bar for bar in page.of_class("i", "faulty left") if "title" in bar]
    assert [(bar["title"], bar["style"]) for bar in bars] == [
        ("At 10. And 1 more thereabouts.", "left:4.167%;width:0.833%"),
        ("At 100.", "left:41.667%;width:0.417%"),
    ]


def test_what_comes_from_the_file_is_escaped_and_nothing_comes_from_elsewhere(scene, tmp_path):
    page = page_of(scene, tmp_path)
    assert "walk <1>.c3d" in page.text
    assert "<1>" not in page.source
    assert "<hand>" not in page.source
    for tag, attrs in page.tags:
        assert tag not in {"script", "link", "img", "iframe", "hand"}
        assert not {"src", "href"} & attrs.keys()
    assert "url(" not in page.source
    assert "http" not in page.source


def test_the_worst_moment_is_the_one_with_most_mended_markers(scene, tmp_path):
    page = page_of(scene, tmp_path)  # only in frame 70 the spike falls together with a gap that is filled
    assert "Frame 171, 0.58 s from the first." in page.text
    before, after = re.findall(r"<svg class=\"figure\".*?</svg>", page.source)
    assert before.count("<circle") == scene.comparison.before.seen[70].sum()
    assert before.count('class="doubted"') == 1
    assert after.count("<circle") == scene.comparison.after.seen[70].sum()
    assert after.count('class="filled"') == after.count('class="replaced"') == 1
    assert ('class="bones"' in after, 'class="bones"' in before) == (True, False)


def test_the_body_faces_the_viewer_in_the_middle_of_the_picture(scene, tmp_path):
    page = page_of(scene, tmp_path)
    left, top, width, height = (float(number) for number in page.of_class("svg", "figure")[1]["viewbox"].split())
    circles = re.findall(r'cx="([-\d.]+)" cy="([-\d.]+)" r="2"><title>(\w+):', page.source.split("</figure>")[1])
    place = {label: (float(x), float(y)) for x, y, label in circles}
    head, foot = scene.comparison.skeleton.index("Head"), scene.comparison.skeleton.index("LeftFoot")
    hands = (place[f"M{scene.comparison.skeleton.index(side + 'Hand'):02d}"][0] for side in ("Right", "Left"))
    assert place[f"M{head:02d}"][1] < place[f"M{foot:02d}"][1]  # an SVG's y points down
    assert left < next(hands) < left + width / 2 < next(hands) < left + width
    assert all(top < y < top + height for _, y in place.values())


def test_the_curve_is_broken_where_nothing_is_known(scene, tmp_path):
    error = np.full((240, 31), 0.004)
    error[100:120] = np.nan
    page = page_of(scene, tmp_path, error=error)
    (curve,) = page.of_class("path", "middle")
    assert curve["d"].count("M") == 2
    assert curve["d"].count("L") == 99 + 119
    assert set(re.findall(r" ([\d.]+)", curve["d"])) == {"0.200"}  # 4 of 5 mm
    assert "5 mm" in page.text


def test_residuals_are_listed_from_the_worst_without_the_unknown(scene, tmp_path):
    text = page_of(scene, tmp_path).text
    assert text.index("M28 30.0 / 31.0") < text.index("M01 3.0 / 4.0")
    assert text.index("LeftHand 12.0 / 21.0") < text.index("LeftFoot 6.0 / 9.0")
    assert "never nan" not in text
    assert "200 solved: well 40 guessed: too few" in text
    assert "LeftLeg 41.8 cm" in text
    assert "LHipJoint" not in text


def test_a_take_without_a_body_reads_well(scene, tmp_path):
    record = scene.report | {"subject": None, "solve": None, "take": scene.report["take"] | {"marker_set": None}}
    page = page_of(scene, tmp_path, record=record, skeleton=None, joints=None, error=None)
    assert "No body was used" in page.text
    assert "None" not in page.text
    assert "The person" not in page.text
    assert "bones" not in {attrs.get("class") for tag, attrs in page.tags if tag == "path"}
    assert len(page.of_class("svg", "figure")) == 2


def test_a_take_without_faults_says_so(scene, tmp_path):
    fill = {"missing_before": 0, "filled": 0, "mended": 0, "relabelled": 0, "left_empty": 0, "left": []}
    whole, sound = scene.comparison.before.replace_markers(scene.comparison.joints), {"fill": fill, "changes": []}
    takes = {"before": whole, "labelled": whole, "after": whole}
    page = page_of(scene, tmp_path, record=scene.report | sound, **takes, faults=Faults(), changes=())
    assert "Nothing: every marker is there in every frame, and none strays." in page.text
    assert "Nothing was changed" in page.text
    assert "Nothing: no sample is missing any more." in page.text
    assert "changes" not in page.text
    assert "kept as it was" not in page.text
    assert not page.of_class("svg", "change")


def test_a_take_without_a_single_sample_has_a_page(scene, tmp_path):
    nothing = scene.comparison.before.replace_markers(np.full_like(scene.comparison.before.markers, np.nan))
    takes = {"before": nothing, "labelled": nothing, "after": nothing}
    page = page_of(scene, tmp_path, **takes, skeleton=None, joints=None, error=np.full((240, 31), np.nan))
    assert "31 left empty" in page.text
    assert not re.search(r"\bnan\b", page.source)


@pytest.mark.parametrize("count", [300, 6000])
def test_the_page_of_a_bad_take_stays_small(scene, tmp_path, count):
    items = tuple(
        Fault("gap", m, 8 * n, 8 * n + 3, 0.1, f"M{m:02d} is not seen for 0.03 s and moves.")
        for m in range(30)
        for n in range(count // 30)
    )
    whole, markers = np.zeros((8 * count // 30, 31, 3)), np.zeros((8 * count // 30, 31, 3))
    for fault in items:
        markers[fault.first : fault.last + 1, fault.marker] = np.nan
    before = replace(scene.comparison.before, markers=markers, unlabelled=None)
    after = before.replace_markers(whole, np.where(np.isnan(markers[..., 0]), 0.01, np.nan))
    made = tuple(
        change
        for change, _ in changes.build_changes(before, before, after, items, None, np.full((len(whole), 31), "the body", object))
    )
    takes = {"before": before, "labelled": before, "after": after, "faults": Faults(items), "changes": made}
    page = page_of(scene, tmp_path, **takes, skeleton=None, joints=None, error=None)
    assert len(page.source.encode()) < 1_500_000
    assert f"{count:,} changes" in page.text
    assert ("And 5,000 more, all in the JSON report." in page.text) == (count > 1000)
    assert len(page.of_class("svg", "change")) == 12
    assert len([attrs for tag, attrs in page.tags if tag == "details" and "open" in attrs]) == 1  # only what is left is short


def test_a_folder_that_is_not_there_is_named(scene, tmp_path):
    with pytest.raises(WriteError, match=r"nowhere.*walk\.html"):
        page_of(scene, tmp_path, target=tmp_path / "nowhere" / "walk.html")
