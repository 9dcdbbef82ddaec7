"""The review page in Chromium: everything by keyboard and by mouse, and the files that this leaves."""

import json
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from playwright.sync_api import Browser, Page, expect, sync_playwright

from mocapfix import pipeline
from mocapfix.animations.lock_feet import LOCK_METHOD
from mocapfix.animations.repair_methods import REPAIR_DESCRIPTIONS
from mocapfix.cli.commands import clean_preview
from mocapfix.fill.gap_windows import FillMethod
from mocapfix.io.c3d import write_c3d
from mocapfix.io.capture import read_capture, read_take
from mocapfix.io.changes_file import EXCLUDED_REASON, write_changes_file
from mocapfix.io.gltf import write_gltf
from mocapfix.io.yaml_files import CorrectionModel
from mocapfix.labels.multi_subject import split_corrected_subjects
from mocapfix.model.animation import Animation
from mocapfix.model.take import Take
from mocapfix.options import CleanOptions
from mocapfix.review.take_files import find_cleaned_takes, load_take_view, trace_marker
from mocapfix.synthetic import compose_take
from tests.io.test_changes_file import build_change
from tests.review.conftest import RunningServer, serve

CHROMIUM = next((path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), None)
SOFTWARE_RENDERING = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
WAIT_MS = 60_000
RUN_DEPENDENT_SUFFIXES = (".rrd", ".report.json", ".report.html", ".review.lock")

expect.set_options(timeout=WAIT_MS)
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium: make browser")


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=SOFTWARE_RENDERING)
        yield browser
        browser.close()


@pytest.fixture
def problems() -> list[str]:
    """What the pages reported to the console as an error."""
    return []


@pytest.fixture
def page(browser: Browser, running: RunningServer, problems: list[str]) -> Iterator[Page]:
    page = open_page(browser, running, problems)
    yield page
    page.context.close()
    assert not problems


def open_page(browser: Browser, running: RunningServer, problems: list[str], place: str = "") -> Page:
    # Playwright evaluates expressions, which the page's policy forbids. test_server checks the policy.
    context = browser.new_context(viewport={"width": 1280, "height": 800}, bypass_csp=True)
    page = context.new_page()
    page.set_default_timeout(WAIT_MS)
    page.on("pageerror", lambda error: problems.append(str(error)))
    page.on("console", lambda message: problems.append(message.text) if message.type == "error" else None)
    page.on("request", lambda sent: problems.append(sent.url) if "127.0.0.1" not in sent.url and ":" in sent.url[:6] else None)
    page.goto(f"{running.address}/{place}")
    wait_until_ready(page)
    return page


def wait_until_ready(page: Page) -> None:
    page.wait_for_selector('html[data-ready="1"]')


def get_take(page: Page) -> dict[str, Any]:
    return page.evaluate("review.getState().take")


def get_selected(page: Page) -> str:
    return page.evaluate("review.getState().selected")


def press_and_wait(page: Page, key: str) -> None:
    """Press a key that edits, and wait until the edit is saved."""
    revision = get_take(page)["revision"]
    page.keyboard.press(key)
    page.wait_for_function("revision => review.getState().take.revision !== revision && !review.app.edits.waiting", arg=revision)


def click_and_wait(page: Page, selector: str) -> None:
    """Click a button that edits, and wait until the edit is saved."""
    revision = get_take(page)["revision"]
    page.locator(selector).click()
    page.wait_for_function("revision => review.getState().take.revision !== revision && !review.app.edits.waiting", arg=revision)


def list_events(page: Page) -> list[dict[str, Any]]:
    return page.evaluate("review.app.events")


def list_declined_samples(page: Page) -> list[list[Any]]:
    """Return marker, frame, state and position of the samples that a decision leaves as measured."""
    return page.evaluate(
        """() => { const { samples, take } = review.app, found = [];
        for (const each of take.changes.filter(each => each.decision !== "accept")) for (const label of each.markers) {
            const m = take.labels.indexOf(label);
            for (let t = each.first - take.first_frame; m >= 0 && t <= each.last - take.first_frame; t++) {
                const state = samples.state[t * take.labels.length + m];
                found.push([label, t, state, ...samples.getPosition("after", t, m).map(String)]);
            }
        }
        return found.sort(); }"""
    )


def select_change(page: Page, name: str) -> None:
    page.evaluate("name => review.app.select(name)", name)


def press_until_open(page: Page, key: str, dialog: str) -> None:
    """Press a key that opens a dialog: a page that still shows another take ignores keys."""
    for _ in range(20):
        page.keyboard.press(key)
        with suppress(AssertionError):
            expect(page.locator(dialog)).to_be_visible(timeout=3000)
            return
    expect(page.locator(dialog)).to_be_visible()


def read_changes(running: RunningServer) -> dict[str, Any]:
    return yaml.safe_load((running.folder / "walk.changes.yaml").read_text(encoding="utf-8"))


def test_a_take_is_reviewed_by_keyboard_and_cleaned_again(page: Page, running: RunningServer) -> None:
    take = get_take(page)
    expect(page.locator("#take-state")).to_have_text("untouched")
    events = list_events(page)
    seen: list[str] = []
    for event in events:  # step through all events: the least certain first, each in the middle of its least certain change
        seen.append(get_selected(page))
        change = event["changes"][0]
        assert page.evaluate("review.getState().frame") == (change["first"] + change["last"]) // 2 - take["first_frame"]
        assert page.locator('#changes .row[aria-selected="true"]').get_attribute("data-id") == seen[-1] == event["id"]
        page.keyboard.press("ArrowDown")
    assert sorted(each["id"] for event in events for each in event["changes"]) == sorted(each["id"] for each in take["changes"])
    known = [each["predicted_mm"] for each in events if each["predicted_mm"] is not None]
    assert known == sorted(known, reverse=True)
    assert max(len(each["changes"]) for each in events) > 1

    one, two, three, four = (each["id"] for each in take["changes"][:4])
    for name, key in ((one, "r"), (two, "r"), (three, "k"), (four, "r")):
        select_change(page, name)
        press_and_wait(page, key)
    press_and_wait(page, "Control+z")
    decisions = {each["id"]: each["decision"] for each in read_changes(running)["changes"]}
    assert {name: decisions[name] for name in (one, two, three, four)} == {
        one: "reject",
        two: "reject",
        three: "keep",
        four: "accept",
    }
    select_change(page, four)
    page.keyboard.press("m")
    page.locator("#note-text").fill("ask Ann")
    press_and_wait(page, "Enter")

    page.keyboard.press("s")
    page.locator("#swap-one").select_option("LKNE")
    page.locator("#swap-other").select_option("RKNE")
    page.locator("#swap-first").fill(str(take["first_frame"] + 50))
    page.locator("#swap-last").fill(str(take["first_frame"] + 89))
    press_and_wait(page, "Enter")
    page.keyboard.press("Home")
    for key in ("Shift+ArrowRight", "[", "Shift+ArrowRight", "]", "w"):
        page.keyboard.press(key)
    page.locator("#mark-marker").select_option("LTOE")
    press_and_wait(page, "Enter")
    first = take["first_frame"]
    assert read_changes(running)["corrections"] == [
        {"kind": "swap", "markers": ["LKNE", "RKNE"], "first": first + 50, "last": first + 89},
        {"kind": "wrong", "markers": ["LTOE"], "first": first + 10, "last": first + 20},
    ]

    shown = list_declined_samples(page)
    assert shown

    expected = running.folder.parent / "expected"
    shutil.copytree(running.folder, expected)
    page.keyboard.press("c")
    page.wait_for_selector("#difference:not([hidden])")
    wait_until_ready(page)
    expect(page.locator("#difference")).to_contain_text("differ from the cleaning before")
    runs = {each["label"]: each["runs"] for each in get_take(page)["difference"]["markers"]}
    assert {first for first, _ in runs["LTOE"]} & set(range(10, 21))  # where it was marked as wrong
    expect(page.locator("#lanes-legend")).to_contain_text("differs from before")
    assert list_declined_samples(page) == shown  # the page showed them before as they are now
    page.keyboard.press("Escape")
    page.keyboard.press("e")
    page.locator('#dialog-export input[value="blender"]').check()
    page.locator("#dialog-export").press("Enter")
    expect(page.locator("#status")).to_have_text("Cleaned again. Written: blender.")
    wait_until_ready(page)  # keys count once the samples of the new cleaning are drawn
    page.keyboard.press("q")
    expect(page.locator("#cover")).to_contain_text("The review has ended")

    command = [sys.executable, "-m", "mocapfix", "clean", str(running.folder.parent / "walk.c3d"), "--prior", "none"]
    command += ["--changes", str(expected / "walk.changes.yaml"), "--out", str(expected), "--overwrite"]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    subprocess.run([*command, "--bvh-for", "blender"], check=True, stdout=subprocess.DEVNULL)
    names = {path.name for path in running.folder.iterdir()}
    assert names - {".review.lock"} == {path.name for path in expected.iterdir()} - {".review.lock"}
    for name in names:
        if not name.endswith(RUN_DEPENDENT_SUFFIXES):
            assert (running.folder / name).read_bytes() == (expected / name).read_bytes(), name


def test_character_rate_and_frames_are_chosen_for_an_export(page: Page, running: RunningServer) -> None:
    take = get_take(page)
    page.keyboard.press("e")
    first, last = page.locator("#export-first"), page.locator("#export-last")
    expect(first).to_be_disabled()  # frames are those of a character
    page.locator('#dialog-export input[value="mixamo"]').check()
    expect(first).to_be_enabled()
    expect(last).to_have_value(str(take["first_frame"] + take["frame_count"] - 1))
    first.fill(str(take["first_frame"] + 5))
    last.fill(str(take["first_frame"] + 24))
    page.locator("#export-rate").fill("30")
    percents = page.evaluate_handle("window.percents = []")
    page.evaluate(
        "new MutationObserver(() => window.percents.push(document.getElementById('progress').value))"
        ".observe(document.getElementById('progress'), { attributes: true })"
    )
    page.locator("#dialog-export").press("Enter")
    expect(page.locator("#status")).to_have_text("Cleaned again. Written: mixamo.")
    shown = percents.json_value()
    rising = shown[: shown.index(max(shown)) + 1]
    assert rising == sorted(rising)
    assert rising[-1] > 50
    expect(page.locator("#progress")).to_be_hidden()
    assert (running.folder / "walk.mixamo.glb").is_file()
    assert get_take(page)["export"]["output_rate_hz"] == 30
    assert get_take(page)["export"]["trim"] == [take["first_frame"] + 5, take["first_frame"] + 24]
    wait_until_ready(page)
    page.keyboard.press("e")
    expect(page.locator("#export-rate")).to_have_value("30")
    expect(first).to_have_value(str(take["first_frame"] + 5))
    expect(page.locator('#dialog-export input[value="mixamo"]')).to_be_checked()
    page.locator("#export-rate").fill("3")  # the browser refuses it
    page.locator("#dialog-export button.primary").click()
    expect(page.locator("#dialog-export")).to_be_visible()
    page.locator("#export-rate").press("Enter")  # by keyboard as well
    page.locator("#export-rate").fill("30")
    first.fill(str(take["first_frame"] - 1))
    first.press("Enter")
    expect(page.locator("#dialog-export")).to_be_visible()
    assert page.evaluate("review.app.take.run.state") != "running"


def test_events_are_decided_by_keyboard(page: Page, running: RunningServer) -> None:
    event = next(each for each in list_events(page) if len(each["changes"]) > 2)
    ids = {each["id"] for each in event["changes"]}
    select_change(page, event["id"])
    rows = page.locator("#changes .row.part")
    assert rows.count() == 0
    page.keyboard.press("Enter")
    assert {row.get_attribute("data-id") for row in rows.all()} == ids
    press_and_wait(page, "r")
    assert {each["id"] for each in read_changes(running)["changes"] if each["decision"] == "reject"} == ids
    assert get_selected(page) not in ids  # it went on to the next event
    select_change(page, event["id"])
    page.keyboard.press("ArrowDown")
    part = get_selected(page)
    assert part in ids
    press_and_wait(page, "a")
    assert {each["id"] for each in read_changes(running)["changes"] if each["decision"] == "reject"} == ids - {part}
    expect(page.locator(f'#changes .row[data-id="{event["id"]}"]')).to_have_attribute("data-decision", "mixed")
    select_change(page, event["id"])
    page.keyboard.press("Enter")
    assert rows.count() == 0


def test_events_are_decided_by_mouse(page: Page, running: RunningServer) -> None:
    event = next(each for each in list_events(page) if len(each["changes"]) > 2)
    row = page.locator(f'#changes .row[data-id="{event["id"]}"]')
    row.locator(".fold").click()
    expect(row).to_have_attribute("aria-expanded", "true")
    parts = page.locator("#changes .row.part")
    assert parts.count() == len(event["changes"])
    parts.nth(1).click()
    click_and_wait(page, "#reject")
    rejected = [each["id"] for each in read_changes(running)["changes"] if each["decision"] == "reject"]
    assert rejected == [event["changes"][1]["id"]]
    row.click()
    click_and_wait(page, "#keep")
    ids = {each["id"] for each in event["changes"]}
    kept = {each["id"] for each in read_changes(running)["changes"] if each["decision"] == "keep"}
    assert kept == ids - set(rejected)  # a change that is reviewed keeps its decision
    row.click()
    click_and_wait(page, "#keep")
    assert {each["id"] for each in read_changes(running)["changes"] if each["decision"] == "keep"} == ids


def test_the_decision_on_a_change_outlasts_that_on_the_rest_of_its_event(page: Page, running: RunningServer) -> None:
    event = next(each for each in list_events(page) if len(each["changes"]) > 2)
    *others, last = (each["id"] for each in event["changes"])
    select_change(page, last)
    for other in page.evaluate("review.app.events.flatMap(each => each.changes.map(change => change.id))"):
        if other not in (*others, last):
            select_change(page, other)
            press_and_wait(page, "k")
    select_change(page, last)
    press_and_wait(page, "r")
    assert get_selected(page) == event["id"]  # what is left
    press_and_wait(page, "a")
    changes = {each["id"]: each for each in read_changes(running)["changes"]}
    assert {each: changes[each]["decision"] for each in others} == dict.fromkeys(others, "accept")
    assert all(changes[each]["reviewed"] for each in others)
    assert changes[last]["decision"] == "reject"


@pytest.mark.parametrize("is_by_mouse", [False, True])
def test_what_lies_above_the_limit_is_never_accepted(page: Page, running: RunningServer, is_by_mouse: bool) -> None:
    events = list_events(page)
    worst = sorted((each["limit_mm"] for each in events if each["limit_mm"] < np.inf), reverse=True)
    limit_mm = max(each for each in page.evaluate("import('./assets/events.js').then(each => each.LIMITS_MM)") if each < worst[2])
    while page.evaluate("review.app.limit.limitMm") != limit_mm:
        is_above = page.evaluate("review.app.limit.limitMm") > limit_mm
        if is_by_mouse:
            page.locator("#limit").press("ArrowLeft" if is_above else "ArrowRight")
        else:
            page.keyboard.press("," if is_above else ".")
    expected = {each["id"] for event in events if event["limit_mm"] <= limit_mm for each in event["changes"]}
    all_ids = {each["id"] for event in events for each in event["changes"]}
    expect(page.locator("#accept-within")).to_contain_text(f"Accept {len(expected)} changes")
    expect(page.locator("#limit-text")).to_contain_text(f"({len(all_ids - expected)} changes) to look at")
    if is_by_mouse:
        click_and_wait(page, "#accept-within")
    else:
        press_and_wait(page, "Shift+A")
    assert get_take(page)["undo_count"] == 1  # one edit
    assert page.locator("dialog[open]").count() == 0
    assert {each["id"] for each in read_changes(running)["changes"] if each.get("reviewed")} == expected
    expect(page.locator("#accept-within")).to_be_disabled()
    page.keyboard.press("Shift+A")
    assert {each["id"] for each in read_changes(running)["changes"] if each.get("reviewed")} == expected


def test_a_filter_hides_nothing_from_the_limit_of_an_event(page: Page) -> None:
    events = [each for each in list_events(page) if len(each["changes"]) > 1 and each["limit_mm"] < np.inf]
    event = max(events, key=lambda each: each["limit_mm"] - each["changes"][-1]["predicted_mm"])
    best, limits = event["changes"][-1], page.evaluate("import('./assets/events.js').then(each => each.LIMITS_MM)")
    limit_mm = next(each for each in limits if best["predicted_mm"] <= each)
    assert limit_mm < event["limit_mm"]
    while page.evaluate("review.app.limit.limitMm") != limit_mm:
        page.keyboard.press("," if page.evaluate("review.app.limit.limitMm") > limit_mm else ".")
    expect(page.locator("#limit-text")).not_to_contain_text("of those listed")
    page.locator("#filter-marker").fill(best["markers"][0])
    listed = next(each for each in list_events(page) if best["id"] in [change["id"] for change in each["changes"]])
    assert listed["limit_mm"] == event["limit_mm"]
    within = "import('./assets/events.js').then(each => each.divideByLimit(review.app.events, review.app.limit.limitMm).within)"
    assert listed["id"] not in [each["id"] for each in page.evaluate(within)]
    expect(page.locator("#limit-text")).to_contain_text("of those listed to look at")


def test_keys_act_after_a_click(page: Page) -> None:
    click_and_wait(page, "#accept")
    revision = get_take(page)["revision"]
    page.keyboard.press(" ")
    page.wait_for_function("review.app.playback.isPlaying")
    assert get_take(page)["revision"] == revision
    page.locator("#sort").select_option("kind")
    press_and_wait(page, "r")
    assert page.locator("#sort").input_value() == "kind"


def test_a_correction_has_the_frames_of_the_marker_that_was_clicked(page: Page) -> None:
    take = get_take(page)
    event = next(each for each in list_events(page) if len({(part["first"], *part["markers"]) for part in each["changes"]}) > 1)
    other = next(each for each in event["changes"][1:] if each["markers"] != event["changes"][0]["markers"])
    label = other["markers"][0]
    place = [event["id"], take["labels"].index(label)]
    page.evaluate("([name, marker]) => review.app.select(name, { keepsFrame: true, marker })", place)
    expect(page.locator("#change-detail")).to_contain_text(other["markers"][0])
    page.keyboard.press("w")
    expect(page.locator("#mark-marker")).to_have_value(label)
    own = next(each for each in event["changes"] if label in each["markers"])
    expect(page.locator("#mark-first")).to_have_value(str(own["first"]))
    expect(page.locator("#mark-last")).to_have_value(str(own["last"]))
    page.keyboard.press("Escape")
    expect(page.locator("#dialog-mark")).to_be_hidden()
    select_change(page, event["id"])  # no marker was clicked: the least certain change
    assert page.evaluate("review.app.change.id") == event["changes"][0]["id"]
    one, two = 3, 4
    pair = [take["labels"][one], take["labels"][two]]
    page.evaluate(
        "pair => { review.app.change.markers = pair; review.app.marker = review.app.take.labels.indexOf(pair[1]); }", pair
    )
    press_until_open(page, "s", "#dialog-swap")
    expect(page.locator("#swap-one")).to_have_value(pair[1])
    expect(page.locator("#swap-other")).to_have_value(pair[0])


def test_a_marker_with_two_changes_in_an_event_offers_the_one_at_this_frame(page: Page) -> None:
    event = next(each for each in list_events(page) if len(each["changes"]) > 1)
    worst, other = event["changes"][0], event["changes"][-1]
    page.evaluate(  # the last change of the event is one of the marker of the first
        """([id, worst, other]) => { const { app } = review, part = app.take.changes.find((each) => each.id === other.id);
        part.markers = worst.markers; part.first = worst.last + 1; part.last = worst.last + 5;
        app.renderReview(); app.select(id); }""",
        [event["id"], worst, other],
    )
    assert page.evaluate("review.app.change.id") == worst["id"]
    first = get_take(page)["first_frame"]
    page.evaluate("t => review.app.playback.moveTo(t)", worst["last"] + 2 - first)
    page.keyboard.press("w")
    expect(page.locator("#mark-first")).to_have_value(str(worst["last"] + 1))
    expect(page.locator("#mark-last")).to_have_value(str(worst["last"] + 5))
    page.keyboard.press("Escape")


def test_stars_follow_the_corrections(page: Page) -> None:
    starred = "review.app.events.flatMap(each => each.changes).filter(each => each.is_correction).map(each => each.id)"
    change = "{ ...review.app.take.changes[0], kind: 'marked', markers: ['LTOE'], first: 5 }"
    page.evaluate(f"review.app.take.changes[0] = {change}")
    assert page.evaluate(starred) == []
    correction = "{ kind: 'wrong', markers: ['LTOE'], first: 5, last: 9 }"
    page.evaluate(f"import('./assets/edits.js').then(each => review.app.edits.send(new each.AddEdit({correction})))")
    assert page.evaluate(starred) == [get_take(page)["changes"][0]["id"]]
    press_and_wait(page, "Control+z")
    assert page.evaluate(starred) == []


def test_undo_and_redo_by_keyboard_and_by_mouse(page: Page, running: RunningServer) -> None:
    path = running.folder / "walk.changes.yaml"
    contents = [path.read_bytes()]
    expect(page.locator("#undo")).to_be_disabled()
    for key in ("r", "k", "a"):
        press_and_wait(page, key)
        contents.append(path.read_bytes())
    for act, expected in (
        (lambda: press_and_wait(page, "Control+z"), contents[2]),
        (lambda: click_and_wait(page, "#undo"), contents[1]),
        (lambda: press_and_wait(page, "Control+y"), contents[2]),
        (lambda: click_and_wait(page, "#redo"), contents[3]),
        (lambda: press_and_wait(page, "Control+z"), contents[2]),
        (lambda: press_and_wait(page, "Control+Shift+z"), contents[3]),
    ):
        act()
        assert path.read_bytes() == expected
    expect(page.locator("#redo")).to_be_disabled()


def test_a_rejected_change_shows_its_state_at_once(page: Page) -> None:
    change = next(each for each in get_take(page)["changes"] if each["kind"] == "gap" and each["samples"] > 5)
    sample = (
        "([name, frame]) => { const { samples, take } = review.app, m = take.labels.indexOf(name), t = frame - take.first_frame; "
    )
    sample += (
        "return [samples.state[t * take.labels.length + m], samples.getPosition('after', t, m).map(each => each.toFixed(6))]; }"
    )
    place = [change["markers"][0], change["first"] + 1]
    state, position = page.evaluate(sample, place)
    assert (state, "NaN" in position) == (1, False)
    select_change(page, change["id"])
    press_and_wait(page, "r")
    assert page.evaluate(sample, place) == [7, ["NaN"] * 3]
    runs = "name => review.app.lanes.lanes[review.app.take.labels.indexOf(name)].runs.filter(run => run[2] === 7)"
    first = get_take(page)["first_frame"]
    assert page.evaluate(runs, place[0]) == [[change["first"] - first, change["last"] - first, 7]]
    expect(page.locator("#lanes-legend")).to_contain_text("rejected")
    press_and_wait(page, "Control+z")
    assert page.evaluate(sample, place) == [state, position]


READ_MARKER = """([label, first, last]) => { const { samples, take } = review.app, m = take.labels.indexOf(label);
    return [...Array(last - first + 1).keys()].map((n) => samples.getPosition("after", first - take.first_frame + n, m)); }"""


def test_an_estimate_of_a_gap_is_taken_by_a_number_and_is_what_the_next_cleaning_fills(
    page: Page, running: RunningServer
) -> None:
    take = get_take(page)
    change = max((each for each in take["changes"] if each["kind"] == "gap"), key=lambda each: each["predicted_mm"])
    label, first, last = stretch = [change["markers"][0], change["first"], change["last"]]
    select_change(page, change["id"])
    before = page.evaluate(READ_MARKER, stretch)
    page.keyboard.press("g")
    page.wait_for_selector("#fills button")
    expect(page.locator("#fills")).to_contain_text(f"{label}, frames {first}–{last}")
    names = ["spline", "markers near it", "rigid group", "body", "similar frames", "straight line", "leave empty"]
    texts = page.locator("#fills button").all_text_contents()
    assert all(text.startswith(f"{n} ") and name in text for n, (name, text) in enumerate(zip(names, texts, strict=True), 1))
    assert [" mm" in text for text in texts].count(True) == page.evaluate("review.app.curves.estimates.length") > 3
    assert page.evaluate("review.app.scene.people[0].layers.estimates.geometry.drawRange.count") > 2  # in the middle of the gap
    expect(page.locator("#fills button").nth(2)).to_be_disabled()
    page.keyboard.press("3")  # there is no rigid group
    expect(page.locator("#status")).to_contain_text("gives no estimate")
    page.keyboard.press("Escape")
    expect(page.locator("#fills")).to_be_hidden()
    assert page.evaluate("review.app.curves.estimates.length") == 0

    page.keyboard.press("g")
    page.wait_for_selector("#fills button")
    press_and_wait(page, "4")
    assert read_changes(running)["corrections"] == [
        {"kind": "fill", "markers": [label], "first": first, "last": last, "method": "body"}
    ]
    shown = page.evaluate(READ_MARKER, stretch)
    assert np.abs(np.subtract(shown, before)).max() > 1e-3
    expect(page.locator("#lanes-legend")).to_contain_text("body")
    press_and_wait(page, "Control+z")
    assert page.evaluate(READ_MARKER, stretch) == before
    press_and_wait(page, "Control+y")
    assert page.evaluate(READ_MARKER, stretch) == shown
    page.reload()
    wait_until_ready(page)
    page.wait_for_function("review.app.samples.requested.size")  # it is shown before it is cleaned
    assert page.evaluate(READ_MARKER, stretch) == shown
    page.keyboard.press("c")
    page.wait_for_selector("#difference:not([hidden])")
    page.wait_for_function("review.app.isComplete")
    np.testing.assert_allclose(page.evaluate(READ_MARKER, stretch), shown, atol=2e-6)  # as shown, but for rounding


def test_estimates_leave_room_for_the_view_which_shows_all_of_them(page: Page) -> None:
    page.set_viewport_size({"width": 1100, "height": 700})
    change = max((each for each in get_take(page)["changes"] if each["kind"] == "gap"), key=lambda each: each["predicted_mm"])
    select_change(page, change["id"])
    page.keyboard.press("g")
    page.wait_for_selector("#fills button")
    bounds = page.locator("#stage").bounding_box()
    assert bounds
    assert bounds["height"] > 230
    places = page.evaluate(
        """() => { const { scene } = review.app, [person] = scene.people;
        return person.listEstimates(scene.frame).map(({ at, layer }) =>
            scene.point.fromArray(layer.values, at).project(scene.camera).toArray()); }"""
    )
    assert len(places) > 2
    assert np.abs(places).max() < 1


def test_kinds_of_changes_stand_in_one_column_and_are_not_cut_off(page: Page) -> None:
    page.set_viewport_size({"width": 1100, "height": 700})
    kinds = page.evaluate(
        """[...document.querySelectorAll("#changes .row:not(.part) .kind")]
        .map(each => [each.getBoundingClientRect().left, each.scrollWidth - each.clientWidth])"""
    )
    assert len(kinds) > 4
    left, cut = np.transpose(kinds)
    assert np.ptp(left) <= 1
    assert cut.max() <= 0


def test_an_estimate_of_a_stretch_is_taken_by_mouse(page: Page, running: RunningServer) -> None:
    take = get_take(page)
    change = max((each for each in take["changes"] if each["kind"] == "gap"), key=lambda each: each["predicted_mm"])
    box, lane = (
        page.locator("#lanes").bounding_box(),
        page.evaluate("review.app.lanes.rows.map(each => each.marker)").index(take["labels"].index(change["markers"][0])),
    )
    assert box
    y, middle = box["y"] + 13 * lane + 6, (change["first"] + change["last"]) // 2 - take["first_frame"]
    start, end = page.evaluate("t => [review.app.lanes.window.x(t), review.app.lanes.window.x(t + 6)]", middle)
    page.mouse.move(box["x"] + start, y)
    page.mouse.down()
    page.mouse.move(box["x"] + end, y, steps=4)
    page.mouse.up()
    first, last = (each + take["first_frame"] for each in page.evaluate("review.app.stretch"))
    page.locator("#fill").click()
    option = page.locator("#fills button").nth(6)
    option.hover()
    page.locator("#fills button").nth(1).hover()
    assert page.evaluate("review.app.curves.estimates.filter(each => each.isActive).map(each => each.method)") == ["cluster"]
    click_and_wait(page, "#fills button:nth-of-type(7)")
    assert np.isnan(
        [
            each if each is not None else np.nan
            for each in np.ravel(page.evaluate(READ_MARKER, [change["markers"][0], first, last]))
        ]
    ).all()
    entry = {"kind": "fill", "markers": change["markers"], "first": first, "last": last, "method": "empty"}
    assert read_changes(running)["corrections"] == [entry]
    page.evaluate("review.app.showMarker(review.app.take.labels.indexOf('RFHD'))")  # measured throughout
    page.evaluate("review.app.setStretch([0, 1])")
    page.keyboard.press("g")
    expect(page.locator("#status")).to_contain_text("no sample is missing or faulty")


def test_points_are_set_by_hand_by_keyboard_and_are_what_the_next_cleaning_makes(page: Page, running: RunningServer) -> None:
    take = get_take(page)
    change = max((each for each in take["changes"] if each["kind"] == "gap"), key=lambda each: each["predicted_mm"])
    label, first, last = stretch = [change["markers"][0], change["first"], change["last"]]
    select_change(page, change["id"])
    start = first + (last - first) // 3
    page.evaluate("frame => review.app.playback.moveTo(frame)", start - take["first_frame"])
    before, before_it = page.evaluate(READ_MARKER, stretch), page.evaluate(READ_MARKER, [label, first - 5, first - 1])
    page.keyboard.press("j")
    for _ in range(20):
        page.keyboard.press("Shift+ArrowUp")
    page.keyboard.press("y")
    page.keyboard.press("Shift+ArrowDown")
    page.keyboard.press("Shift+ArrowRight")
    page.keyboard.press("j")
    expect(page.locator("#fills")).to_contain_text(f"{label}, frames {first}–{last}: 2 points by hand")
    page.keyboard.press("j")
    page.keyboard.press("Enter")
    expect(page.locator("#status")).to_contain_text("two points")
    page.keyboard.press("j")
    press_and_wait(page, "Enter")
    expect(page.locator("#fills")).to_be_hidden()
    [entry] = read_changes(running)["corrections"]
    at = start - first
    expected = np.multiply(before[at], 1000) + [0, 20, -1]  # in mm
    assert (entry["kind"], entry["markers"], entry["first"], entry["last"]) == ("keys", [label], first, last)
    np.testing.assert_allclose(entry["points"][0], [start, *expected], atol=0.02)
    shown = page.evaluate(READ_MARKER, stretch)
    np.testing.assert_allclose(np.multiply(shown[at], 1000), expected, atol=0.02)
    outside = [label, first - 5, first - 1]
    assert page.evaluate(READ_MARKER, outside) == before_it  # the spline goes on from there
    assert np.linalg.norm(np.diff([*before_it, *shown], axis=0), axis=1).max() < 0.1
    expect(page.locator("#lanes-legend")).to_contain_text("set by hand")
    page.reload()
    wait_until_ready(page)
    page.wait_for_function("review.getState().isComplete")
    assert page.evaluate(READ_MARKER, stretch) == shown
    page.keyboard.press("c")
    page.wait_for_selector("#difference:not([hidden])")
    page.wait_for_function("review.app.isComplete")
    np.testing.assert_allclose(page.evaluate(READ_MARKER, stretch), shown, atol=2e-5)  # as shown, but for rounding
    assert any("reviewer set by hand" in each["method"] for each in get_take(page)["changes"])


def test_points_are_set_by_hand_with_the_mouse(page: Page, running: RunningServer) -> None:
    take = get_take(page)
    change = max((each for each in take["changes"] if each["kind"] == "gap"), key=lambda each: each["predicted_mm"])
    select_change(page, change["id"])
    box = page.locator("#curves").bounding_box()
    assert box
    one, two = change["first"] + 10 - take["first_frame"], change["first"] + 30 - take["first_frame"]

    def find_place(frame: int, value: str) -> tuple[float, float]:
        x = page.evaluate("t => review.app.curves.window.x(t)", frame)
        return box["x"] + x, box["y"] + page.evaluate(f"t => review.app.curves.rows[1].y({value})", frame)

    shown = "1000 * review.app.samples.getPosition('after', t, review.app.marker)[1]"
    page.keyboard.down("Control")
    for frame in (one, two):
        x, y = find_place(frame, shown)
        page.mouse.click(x, y - 5)
    keys = "[...review.app.keys.points.entries()].sort((a, b) => a[0] - b[0])"
    assert [frame for frame, _ in page.evaluate(keys)] == pytest.approx([one, two], abs=1)
    frame, at = page.evaluate(keys)[0]
    x, y = find_place(frame, "1000 * review.app.keys.points.get(t)[1]")
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x, y + 12, steps=3)
    page.mouse.up()
    moved = page.evaluate(keys)[0][1]
    assert moved[1] < at[1]
    assert (moved[0], moved[2]) == (at[0], at[2])
    page.mouse.click(*find_place(frame, "1000 * review.app.keys.points.get(t)[1]"))  # a click takes the point away
    assert len(page.evaluate(keys)) == 1
    expect(page.locator("#fills button").first).to_be_disabled()
    page.mouse.click(x, y + 12)
    page.keyboard.up("Control")
    click_and_wait(page, "#fills button:first-of-type")
    [entry] = read_changes(running)["corrections"]
    assert (entry["kind"], len(entry["points"])) == ("keys", 2)
    click_and_wait(page, "#undo")
    assert "corrections" not in read_changes(running)


def test_labels_are_corrected_by_clicks_and_keys(browser: Browser, folder: Path, problems: list[str]) -> None:
    path = folder.parent / "walk.c3d"
    take = read_capture(path)
    assert isinstance(take, Take)
    loose = np.full((take.frame_count, 2, 3), np.nan)
    loose[40:60, 0], loose[100:130, 1] = [0.3, 1.2, 0.4], [-0.4, 1.0, 0.2]
    write_c3d(path, replace(take, unlabelled=Take(loose, ("*1", "*2"), take.rate, take.first_frame), layout=None))
    with serve(folder) as running:
        page = open_page(browser, running, problems)
        page.wait_for_function("review.getState().isComplete")
        first, labels = get_take(page)["first_frame"], get_take(page)["labels"]
        stage, lanes = page.locator("#stage").bounding_box(), page.locator("#lanes").bounding_box()
        assert stage
        assert lanes

        def find_place(marker: int, layer: str = "after") -> tuple[float, float]:
            at = page.evaluate("([m, layer]) => review.app.scene.projectMarker(m, layer)", [marker, layer])
            return stage["x"] + at["x"], stage["y"] + at["y"]

        def click_name(label: str) -> None:
            page.evaluate("review.app.lanes.box.scrollTop = 0")
            row = page.evaluate("m => review.app.lanes.rows.findIndex((each) => each.marker === m)", labels.index(label))
            revision = get_take(page)["revision"]
            page.mouse.click(lanes["x"] + 20, lanes["y"] + 13 * row + 6)
            page.wait_for_function("revision => review.getState().take.revision !== revision", arg=revision)

        one, two = (
            {"kind": "assign", "first": first + 40, "last": first + 59},
            {"kind": "assign", "first": first + 100, "last": first + 129},
        )
        page.locator("#lanes-order").select_option("body")
        page.keyboard.press("Escape")
        page.keyboard.press("Home")
        page.keyboard.press("Tab")
        expect(page.locator("#marker-label")).to_have_text("*1")
        click_name(labels[2])
        page.keyboard.press("Home")
        page.keyboard.press("Tab")
        page.keyboard.press("Tab")
        page.keyboard.press("u")
        page.locator("#assign-marker").select_option(labels[3])
        press_and_wait(page, "Enter")
        expected = [one | {"markers": [labels[2], "*1"]}, two | {"markers": [labels[3], "*2"]}]
        assert read_changes(running)["corrections"] == expected
        page.mouse.click(*find_place(1, "unlabelled"))
        click_name(labels[4])
        assert read_changes(running)["corrections"] == [*expected, two | {"markers": [labels[4], "*2"]}]
        for _ in range(3):
            press_and_wait(page, "Control+z")

        pair = [labels.index("LKNE"), labels.index("RKNE")]
        start = 150
        page.evaluate("t => review.app.playback.moveTo(t)", start)
        page.keyboard.press("1")
        page.mouse.click(*find_place(pair[0]))
        page.evaluate("t => review.app.playback.moveTo(t)", start)
        page.keyboard.down("Control")
        page.mouse.click(*find_place(pair[1]))
        page.keyboard.up("Control")
        expect(page.locator("#status")).to_contain_text("S swaps LKNE and RKNE")
        press_and_wait(page, "s")
        [swap] = read_changes(running)["corrections"]
        is_shown = take.visible[start:, [take.labels.index(label) for label in ("LKNE", "RKNE")]]
        end = start + np.argmin(np.r_[is_shown.min(1), False]) - 1
        assert swap == {"kind": "swap", "markers": ["LKNE", "RKNE"], "first": first + start, "last": first + end}
        press_and_wait(page, "Control+z")

        page.keyboard.press("Escape")
        page.keyboard.press("Shift+S")
        expect(page.locator("#exchange-what")).to_contain_text("left and right: ")
        press_and_wait(page, "Enter")
        swaps = read_changes(running)["corrections"]
        sides = {(label, f"R{label[1:]}") for label in labels if label[0] == "L" and f"R{label[1:]}" in labels}
        assert {tuple(each["markers"]) for each in swaps} == sides
        assert {(each["first"], each["last"]) for each in swaps} == {(first, first + take.frame_count - 1)}
        press_and_wait(page, "Control+z")
        assert "corrections" not in read_changes(running)
        page.context.close()
    assert not problems


@pytest.fixture(scope="module")
def cleaned_duo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a take of two people, duo.c3d, and of its outputs, duo.mocapfix. Not to be changed."""
    folder = tmp_path_factory.mktemp("duo")
    one, other = (compose_take(seed=seed, seconds=3.0, rate=60.0) for seed in (3, 4))
    markers = np.concatenate([one.damaged_positions, other.damaged_positions + [1.2, 0.0, 0.3]], axis=1)
    labels = (*(f"Ann:{label}" for label in one.labels), *(f"Bob:{label}" for label in other.labels))
    write_c3d(folder / "duo.c3d", Take(markers, labels, 60.0))
    pipeline.clean(folder / "duo.c3d", prior="none").write(folder / "duo.mocapfix")
    return folder


READ_PEOPLE = """layer => Object.fromEntries(review.app.scene.people.map(({ take, samples }) => [take.subject,
    take.labels.map((_, m) => [...Array(take.frame_count).keys()].map((t) => samples.getPosition(layer, t, m)))]))"""


def read_people(page: Page, layer: str) -> dict[str, np.ndarray]:
    """Return the positions (M, T, 3) of each person as the page has them."""
    return {name: np.array(rows, float) for name, rows in page.evaluate(READ_PEOPLE, layer).items()}


@pytest.mark.parametrize("is_by_mouse", [False, True])
def test_labels_of_two_people_are_exchanged_as_the_command_line_does(
    browser: Browser, cleaned_duo: Path, tmp_path: Path, problems: list[str], is_by_mouse: bool
) -> None:
    shutil.copytree(cleaned_duo, tmp_path / "session")
    folder = tmp_path / "session" / "duo.mocapfix"
    with serve(folder) as running:
        page = open_page(browser, running, problems)
        page.wait_for_function("review.app.scene.people.length === 2 && review.getState().isComplete")
        take, other = page.evaluate("review.app.scene.people.map(each => ({ ...each.take }))")
        path, first = folder / f"duo.{take['subject']}.changes.yaml", take["first_frame"]
        untouched, before = path.read_bytes(), read_people(page, "before")
        running.session.approve(other["id"], "Cid")
        start, end = (40, 70) if is_by_mouse else (0, take["frame_count"] - 1)  # a stretch, or the whole take
        if is_by_mouse:
            page.evaluate("review.app.playback.moveTo(40)")
            for key in ("[", *["Shift+ArrowRight"] * 3, "]"):
                page.keyboard.press(key)
            page.locator("#exchange").click()
            page.locator("#exchange-what").select_option(index=1)
            click_and_wait(page, "#dialog-exchange button.primary")
        else:
            page.keyboard.press("Shift+S")
            page.keyboard.press("ArrowDown")
            press_and_wait(page, "Enter")
        swaps = yaml.safe_load(path.read_text(encoding="utf-8"))["corrections"]
        names = [label.removeprefix("Ann:") for label in [*take["labels"], *other["labels"]] if label.startswith("Ann:")]
        pairs = {tuple(f"{each['subject']}:{name}" for each in (take, other)) for name in names}
        assert {tuple(each["markers"]) for each in swaps} == pairs
        assert {(each["kind"], each["first"], each["last"]) for each in swaps} == {("swap", first + start, first + end)}
        assert get_take(page)["undo_count"] == 1  # one edit
        assert not (folder / f"duo.{other['subject']}.approval.json").exists()  # its samples will differ
        order = [other["labels"].index(label.replace(take["subject"], other["subject"])) for label in take["labels"]]
        shown, frames = read_people(page, "after"), slice(start, end + 1)
        np.testing.assert_array_equal(shown[take["subject"]][:, frames], before[other["subject"]][order, frames])
        np.testing.assert_array_equal(shown[other["subject"]][order, frames], before[take["subject"]][:, frames])
        press_and_wait(page, "Control+z")
        assert path.read_bytes() == untouched
        assert not np.array_equal(read_people(page, "after")["Ann"], shown["Ann"], equal_nan=True)
        press_and_wait(page, "Control+y")

        one, two = (np.isfinite(before[each["subject"]][..., 0]).min(1) for each in (take, other))
        marker = int(np.flatnonzero(one & two[order])[0])
        if is_by_mouse:
            for index, person in ((marker, 0), (order[marker], 1)):
                page.evaluate("review.app.playback.moveTo(120)")
                page.keyboard.press("1")
                place = page.evaluate(
                    "([m, n]) => review.app.scene.projectMarker(m, 'after', review.app.scene.people[n])", [index, person]
                )
                stage = page.locator("#stage").bounding_box()
                assert stage
                page.keyboard.down("Control") if person else None
                page.mouse.click(stage["x"] + place["x"], stage["y"] + place["y"])
            page.keyboard.up("Control")
            page.evaluate("review.app.playback.moveTo(120)")
        else:
            page.keyboard.press("Escape")
            page.keyboard.press("s")
            page.locator("#swap-one").select_option(take["labels"][marker])
            page.locator("#swap-other").select_option(other["labels"][order[marker]])
            page.locator("#swap-first").fill(str(first + 120))
            page.locator("#swap-last").fill(str(first + take["frame_count"] - 1))
        press_and_wait(page, "s" if is_by_mouse else "Enter")
        last = yaml.safe_load(path.read_text(encoding="utf-8"))["corrections"][-1]
        pair = [take["labels"][marker], other["labels"][order[marker]]]
        assert last == {"kind": "swap", "markers": pair, "first": first + 120, "last": first + take["frame_count"] - 1}
        shown = read_people(page, "after")
        page.reload()
        wait_until_ready(page)
        page.wait_for_function("review.app.scene.people.length === 2")
        for name, positions in read_people(page, "after").items():
            np.testing.assert_array_equal(positions, shown[name])

        expected = tmp_path / "session" / "expected"
        shutil.copytree(folder, expected)
        page.keyboard.press("c")
        expect(page.locator("#status")).to_have_text("Cleaned again.")
        page.wait_for_function("review.app.scene.people.length === 2")
        assert not any(each["is_pending"] for each in get_take(page)["corrections"])
        for name, positions in read_people(page, "after").items():
            is_equal = (positions == shown[name]) | np.isnan(shown[name])
            assert is_by_mouse or is_equal.mean() > 0.95  # but for faults of its samples; what is of another person is faulty
            assert np.isfinite(positions).mean() > 0.99
        page.keyboard.press("q")
        expect(page.locator("#cover")).to_contain_text("The review has ended")
        page.context.close()
    assert not problems
    command = [sys.executable, "-m", "mocapfix", "clean", str(tmp_path / "session" / "duo.c3d"), "--prior", "none"]
    command += [part for name in ("Ann", "Bob") for part in ("--changes", str(expected / f"duo.{name}.changes.yaml"))]
    subprocess.run([*command, "--out", str(expected), "--overwrite"], check=True, stdout=subprocess.DEVNULL)
    names = {each.name for each in folder.iterdir()} - {".review.lock"}
    assert names == {each.name for each in expected.iterdir()} - {".review.lock"}
    for name in names:
        if not name.endswith(RUN_DEPENDENT_SUFFIXES):
            assert (folder / name).read_bytes() == (expected / name).read_bytes(), name


COUNT_FAULTY_ROWS = """() => { const { canvas } = review.app.curves, { width, height } = canvas, rows = new Set();
    const text = getComputedStyle(document.documentElement).getPropertyValue("--faulty").trim().slice(1);
    const colour = text.match(/../g).map((each) => parseInt(each, 16));
    const { data } = canvas.getContext("2d").getImageData(0, 0, width, height);
    const isFaulty = (n) => colour.every((each, k) => Math.abs(each - data[n + k]) < 60);
    for (let n = 0; n < data.length; n += 4) if (isFaulty(n)) rows.add(Math.floor(n / 4 / width));
    return rows.size; }"""


def test_a_swap_of_a_protected_marker_is_shown_as_not_made(browser: Browser, folder: Path, problems: list[str]) -> None:
    path = folder / "walk.report.json"
    report = json.loads(path.read_bytes())
    path.write_text(json.dumps(report | {"arguments": [*report["arguments"], "--keep", "LKNE"]}), encoding="utf-8")
    with serve(folder) as running:
        page = open_page(browser, running, problems)
        page.wait_for_function("review.getState().isComplete")
        before = page.evaluate("Array.from(review.app.samples.after).map(String)")
        page.keyboard.press("s")
        page.locator("#swap-one").select_option("RKNE")
        page.locator("#swap-other").select_option("LKNE")
        press_and_wait(page, "Enter")
        expect(page.locator("#status")).to_contain_text(f"It is not made: {EXCLUDED_REASON}.")
        row = page.locator("#corrections .row")
        expect(row).to_contain_text("RKNE, LKNE: not made")
        assert row.get_attribute("title") == f"Not made: {EXCLUDED_REASON}"
        assert page.evaluate("Array.from(review.app.samples.after).map(String)") == before
        page.context.close()
    assert not problems


def test_the_curve_of_a_short_fault_is_joined_to_what_was_measured(page: Page) -> None:
    page.wait_for_function("review.getState().isComplete")
    spike = min((each for each in get_take(page)["changes"] if each["kind"] == "spike"), key=lambda each: each["samples"])
    assert spike["samples"] <= 3
    select_change(page, spike["id"])
    page.evaluate("review.app.playback.moveTo(0)")  # the line of the frame hides a short curve
    assert page.evaluate(COUNT_FAULTY_ROWS) > 10  # a line from the samples beside it, not a point


def test_swaps_of_two_people_and_of_one_are_shown_in_the_order_of_the_next_cleaning(
    browser: Browser, cleaned_duo: Path, tmp_path: Path, problems: list[str]
) -> None:
    shutil.copytree(cleaned_duo, tmp_path / "session")
    folder = tmp_path / "session" / "duo.mocapfix"
    path, report = folder / "duo.Ann.changes.yaml", folder / "duo.Ann.report.json"
    one, right, other = "Ann:LKNE", "Ann:RKNE", "Bob:LKNE"
    made = CorrectionModel(kind="swap", markers=[one, right], first=21, last=80)  # a cleaning has made it
    file, values = yaml.safe_load(path.read_text(encoding="utf-8")), json.loads(report.read_bytes())
    others = yaml.safe_load((folder / "duo.Bob.changes.yaml").read_text(encoding="utf-8"))["changes"]
    fault = next(each for each in others if each["kind"] == "spike" and each["markers"][0][4:] not in ("LKNE", "RKNE"))
    faulty, interval = fault["markers"][0], slice(fault["first"] - 1, fault["last"])
    rejected = fault | {"id": "swap", "kind": "swap", "markers": [faulty.replace("Bob", "Ann"), faulty], "decision": "reject"}
    file |= {"changes": [*file["changes"], rejected], "corrections": [made.model_dump(exclude_defaults=True)]}
    path.write_text(yaml.safe_dump(file, sort_keys=False), encoding="utf-8")
    values["corrections"] = [made.model_dump(mode="json")]
    report.write_text(json.dumps(values), encoding="utf-8")
    with serve(folder) as running:
        page = open_page(browser, running, problems)
        page.evaluate("review.app.openTake('duo.Ann')")
        page.wait_for_function("review.app.scene.people.length === 2 && review.getState().isComplete")
        labels = dict(page.evaluate("review.app.scene.people.map(({ take }) => [take.subject, take.labels])"))

        def read(layer: str) -> dict[str, np.ndarray]:
            people = read_people(page, layer)
            return {name: people[name[:3]][labels[name[:3]].index(name)] for name in (one, right, other, faulty)}

        before, cleaned = read("before"), read("after")
        np.testing.assert_array_equal(cleaned[faulty][interval], before[faulty][interval])  # a rejected exchange concerns both
        swap = f"new AddEdit({{ kind: 'swap', markers: ['{one}', '{other}'], first: 41, last: 60 }})"
        send = f"import('./assets/edits.js').then(({{ AddEdit }}) => review.app.edits.send({swap}))"
        page.evaluate(send)
        shown, frames = read("after"), slice(40, 60)
        for name, source in ((one, right), (right, other), (other, one)):  # that of two people first
            np.testing.assert_array_equal(shown[name][frames], before[source][frames])
            np.testing.assert_array_equal(np.delete(shown[name], frames, 0), np.delete(cleaned[name], frames, 0))
        running.session.approve("duo.Bob", "Cid")
        page.evaluate(send)  # the same once more takes it back
        assert not (folder / "duo.Bob.approval.json").exists()
        page.context.close()
    assert not problems


def test_exchanges_of_three_people_in_the_same_frames_are_shown_in_the_order_in_which_they_are_made(
    browser: Browser, tmp_path: Path, problems: list[str]
) -> None:
    names, path, folder = ("Cid", "Ann", "Bob"), tmp_path / "trio.c3d", tmp_path / "trio.mocapfix"
    truths = [compose_take(seed=seed, seconds=2.0, rate=60.0) for seed in (3, 4, 5)]
    markers = np.concatenate([each.marker_positions + [1.2 * n, 0.0, 0.3 * n] for n, each in enumerate(truths)], axis=1)
    labels = tuple(f"{name}:{label}" for name, each in zip(names, truths, strict=True) for label in each.labels)
    write_c3d(path, Take(markers, labels, 60.0))
    pipeline.clean(path, prior="none", is_fast=True).write(folder)
    files = tuple(folder / f"trio.{name}.changes.yaml" for name in names)
    for file, pair, frames in ((files[2], ("Bob", "Cid"), (11, 60)), (files[1], ("Ann", "Bob"), (31, 90))):
        swap = {"kind": "swap", "markers": [f"{name}:LKNE" for name in pair], "first": frames[0], "last": frames[1]}
        values = yaml.safe_load(file.read_text(encoding="utf-8")) | {"corrections": [swap]}
        file.write_text(yaml.safe_dump(values, sort_keys=False), encoding="utf-8")
    exchanged = split_corrected_subjects(read_take(path), CleanOptions().change(review_files=files))[2].take
    expected = {name: exchanged.markers[:, exchanged.labels.index(f"{name}:LKNE")] for name in names}
    with serve(folder) as running:
        for name in names:
            page = open_page(browser, running, problems, f"#trio.{name}")
            page.wait_for_function("review.app.scene.people.length === 3 && review.getState().isComplete")
            people = dict(page.evaluate("review.app.scene.people.map(({ take }) => [take.subject, take.labels])"))
            shown = read_people(page, "after")
            for each in names:
                knee = shown[each][people[each].index(f"{each}:LKNE")]
                np.testing.assert_allclose(knee[10:90], expected[each][10:90], atol=1e-6)
            page.context.close()
    assert not problems


def test_rejected_changes_of_all_kinds_are_shown_as_the_next_cleaning_leaves_them(
    browser: Browser, tmp_path: Path, problems: list[str]
) -> None:
    truth = compose_take(seed=3, seconds=6.0, rate=60.0)
    markers, labels = truth.damaged_positions.copy(), list(truth.labels)
    for pair, frames in ((("LKNE", "RKNE"), slice(100, 180)), (("LWRA", "LWRB"), slice(250, 290))):
        one, other = map(labels.index, pair)
        markers[frames, [one, other]] = markers[frames, [other, one]]
    loose, toe = np.full((len(markers), 1, 3), np.nan), labels.index("LTOE")
    loose[200:260, 0], markers[200:260, toe] = markers[200:260, toe], np.nan
    write_c3d(tmp_path / "walk.c3d", Take(markers, tuple(labels), 60.0, 1, unlabelled=Take(loose, ("*1",), 60.0, 1)))
    pipeline.clean(tmp_path / "walk.c3d", prior="none").write(tmp_path / "walk.mocapfix")
    with serve(tmp_path / "walk.mocapfix") as running:
        page = open_page(browser, running, problems)
        assert {each["kind"] for each in get_take(page)["changes"]} >= {"gap", "spike", "swap", "fragment"}
        page.wait_for_function("review.getState().isComplete")
        revision = get_take(page)["revision"]
        reject = "review.app.edits.send(new DecideEdit(review.app.take.changes, 'reject'))"
        page.evaluate(f"import('./assets/edits.js').then(({{ DecideEdit }}) => {reject})")
        page.wait_for_function("revision => review.getState().take.revision !== revision", arg=revision)
        shown = "[review.app.samples.after, review.app.samples.state].map(each => Array.from(each, String).join())"
        before = page.evaluate(shown)
        page.keyboard.press("c")
        expect(page.locator("#status")).to_have_text("Cleaned again.")
        page.wait_for_function("review.getState().isComplete")
        assert page.evaluate(shown) == before
        page.context.close()
    assert not problems


def test_lanes_name_every_method_of_estimating() -> None:
    text = (Path(pipeline.__file__).parent / "review" / "page" / "lanes.js").read_text(encoding="utf-8")
    words = re.findall(r'word: "([^"]+)"', text)
    descriptions = [*(method.description for method in FillMethod), *filter(None, REPAIR_DESCRIPTIONS.values()), LOCK_METHOD]
    assert [text for text in descriptions if not any(word in text for word in words)] == []


def test_lanes_are_used_by_mouse(page: Page) -> None:
    take = get_take(page)
    box = page.locator("#lanes").bounding_box()
    assert box
    page.locator("#lanes-order").select_option("body")
    rows = page.evaluate("review.app.lanes.rows.map(each => each.marker)")
    assert rows == list(range(len(take["labels"])))
    page.locator("#lanes-order").select_option("error")
    worst = page.evaluate("review.app.lanes.rows[0].marker")
    change = max((each for each in take["changes"] if each["predicted_mm"]), key=lambda each: each["predicted_mm"])
    assert take["labels"][worst] in change["markers"]
    select_change(page, list_events(page)[-1]["id"])
    page.evaluate("review.app.lanes.box.scrollTop = 0")
    frame = (change["first"] + change["last"]) // 2 - take["first_frame"]
    x = page.evaluate("frame => review.app.lanes.window.x(frame)", frame)
    page.mouse.click(box["x"] + x, box["y"] + 6)  # the first lane
    assert abs(page.evaluate("review.getState().frame") - frame) <= 1
    assert change["id"] in page.evaluate("review.app.entry.changes.map(each => each.id)")
    assert page.evaluate("review.app.marker") == worst

    second = page.evaluate("review.app.lanes.rows[1].marker")
    start, end = page.evaluate("[review.app.lanes.window.x(20), review.app.lanes.window.x(60)]")
    page.mouse.move(box["x"] + end, box["y"] + 19)
    page.mouse.down()
    page.mouse.move(box["x"] + start, box["y"] + 19, steps=4)
    page.mouse.up()
    stretch = page.evaluate("review.app.stretch")
    assert np.abs(np.subtract(stretch, [20, 60])).max() <= 1
    assert page.evaluate("review.app.marker") == second
    page.keyboard.press("w")
    expect(page.locator("#mark-marker")).to_have_value(take["labels"][second])
    expect(page.locator("#mark-first")).to_have_value(str(stretch[0] + take["first_frame"]))
    page.keyboard.press("Escape")

    page.mouse.move(box["x"] + start, box["y"] + 19)
    page.mouse.wheel(0, -100)
    page.wait_for_function("review.app.lanes.window.last - review.app.lanes.window.first < 0.9 * review.app.lastFrame")
    assert abs(page.evaluate("review.app.lanes.window.x(20)") - start) < 10  # about the pointer
    page.mouse.dblclick(box["x"] + start, box["y"] + 19)
    page.wait_for_function("review.app.lanes.window.isWhole")
    page.mouse.move(box["x"] + 20, box["y"] + 19)
    page.mouse.wheel(0, 100)  # over the names the wheel scrolls
    page.wait_for_function("review.app.lanes.box.scrollTop > 0")


def test_curves_show_the_distance_to_the_body_by_keyboard_and_by_mouse(page: Page, running: RunningServer) -> None:
    (take,), (state,) = find_cleaned_takes(running.folder), page.evaluate("[review.getState()]")
    view, label = load_take_view(take), state["take"]["labels"][page.evaluate("review.app.marker")]
    for _ in range(3):
        page.keyboard.press("i")
    expect(page.locator("#curves-quantity")).to_have_value("body")
    page.wait_for_function("review.app.samples.traces.get(review.app.marker)?.length")
    body_m = trace_marker(take, view, label)
    for layer, positions in (("before", view.before), ("after", view.after)):
        value = "([layer, t]) => review.app.curves.rows[0].value(layer, review.app.marker, t)"
        m, frame = view.labels.index(label), 20
        expected_mm = 1000 * np.linalg.norm(positions[frame, m] - body_m[frame])
        shown = page.evaluate(value, [layer, frame])
        assert shown == pytest.approx(expected_mm, abs=0.01) or (shown is None and np.isnan(expected_mm))
    page.keyboard.press("i")  # rotations are of animations
    expect(page.locator("#curves-quantity")).to_have_value("position")
    page.locator("#curves-quantity").select_option("body")
    assert page.locator("#curves-quantity option[value=rotation]").evaluate("each => each.disabled")


def test_zoom_and_curves_by_keyboard_and_by_mouse(page: Page) -> None:
    change = next(each for each in get_take(page)["changes"] if each["last"] - each["first"] < 40)
    select_change(page, change["id"])
    page.keyboard.press("z")
    first, last = page.evaluate(
        "[review.app.lanes.window.first, review.app.lanes.window.last].map(each => each + review.app.take.first_frame)"
    )
    assert first <= change["first"] <= change["last"] <= last
    assert last - first < 120
    page.keyboard.press("z")
    assert page.evaluate("review.app.lanes.window.isWhole")
    curves = page.locator("#curves").bounding_box()
    assert curves
    length = "review.app.curves.window.last - review.app.curves.window.first"
    before = page.evaluate(length)
    page.mouse.move(curves["x"] + 300, curves["y"] + 90)
    page.mouse.wheel(0, -100)
    page.wait_for_function(f"before => {length} < 0.9 * before", arg=before)
    left = page.evaluate("review.app.curves.window.first")
    page.keyboard.down("Alt")
    page.mouse.down()
    page.mouse.move(curves["x"] + 200, curves["y"] + 90, steps=3)
    page.mouse.up()
    page.keyboard.up("Alt")
    assert page.evaluate("review.app.curves.window.first") > left
    page.keyboard.press("i")
    expect(page.locator("#curves-quantity")).to_have_value("speed")
    page.locator("#curves-quantity").select_option("distance")
    expect(page.locator("#curves-reference")).to_be_visible()
    assert page.evaluate("review.app.curves.reference !== review.app.curves.marker")
    page.keyboard.down("Control")
    page.mouse.wheel(0, -100)
    page.keyboard.up("Control")
    page.wait_for_function("review.app.curves.magnification > 1")
    count = page.evaluate("review.app.curves.markers.length")
    page.locator("#lanes").click(position={"x": 400, "y": 45}, modifiers=["Control"])
    assert page.evaluate("review.app.curves.markers.length") in (count + 1, count - 1)


def test_commands_are_found_by_a_word(page: Page, running: RunningServer) -> None:
    page.keyboard.press("Control+k")
    page.keyboard.type("redo undone")
    assert page.locator("#palette-list li").count() == 0
    page.locator("#palette-text").fill("swap")
    expect(page.locator("#palette-list li")).to_have_count(2)  # of two labels, and those of two people
    expect(page.locator("#palette-list")).to_contain_text("of two people")
    page.locator("#palette-text").fill("not made")
    expect(page.locator("#palette-list li")).to_have_count(1)
    press_and_wait(page, "Enter")
    assert "reject" in {each["decision"] for each in read_changes(running)["changes"]}
    page.locator("#palette-button").click()
    page.locator("#palette-text").fill("undo")
    page.locator("#palette-list li").filter(has_text="undo the last edit").click()
    page.wait_for_function("review.app.take.redo_count === 1")
    assert {each["decision"] for each in read_changes(running)["changes"]} == {"accept"}
    page.keyboard.press("Control+k")
    page.locator("#palette-text").fill("undo the last")
    refused = page.locator("#palette-list li")
    expect(refused).to_have_attribute("aria-disabled", "true")
    expect(refused).to_contain_text("There is nothing to undo.")
    page.keyboard.press("Escape")
    assert page.locator("dialog[open]").count() == 0


def test_every_control_has_a_name(page: Page) -> None:
    unnamed = page.evaluate(
        """[...document.querySelectorAll("button, select, input, canvas, textarea")].filter(each =>
        !(each.title || each.ariaLabel || each.labels?.length || /[a-z]/i.test(each.textContent))).map(each => each.outerHTML)"""
    )
    assert unnamed == []


@pytest.mark.parametrize("width", [1100, 1440, 2560])
def test_marker_names_are_complete_at_every_width(page: Page, width: int) -> None:
    page.set_viewport_size({"width": width, "height": 800})
    page.evaluate("review.app.unfolded = new Set(review.app.events.map(each => each.id)); review.app.renderReview()")
    is_cut = "each => each.scrollWidth > each.clientWidth + 1"
    assert page.evaluate(f"[...document.querySelectorAll('#changes :is(.name, .number)')].filter({is_cut}).length") == 0
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    assert page.evaluate("document.querySelector('#end').getBoundingClientRect().right <= innerWidth")
    find_box = "id => document.getElementById(id).getBoundingClientRect().toJSON()"
    assert page.evaluate(find_box, "hint")["height"] < 30  # one line
    page.locator("#division").select_option("states")
    page.keyboard.press("0")
    bar, legend, stage = (page.evaluate(find_box, each) for each in ("view-bar", "legend", "stage"))
    assert bar["bottom"] <= legend["top"]
    page.wait_for_function("review.getState().isComplete")
    page.keyboard.press("0")
    places = page.evaluate("review.app.take.labels.map((_, m) => review.app.scene.projectMarker(m)?.y).filter(Boolean)")
    assert min(places) + stage["top"] > legend["bottom"]  # the legend is above the pictures


def test_a_preview_is_shown_while_the_take_is_cleaned_in_full(browser: Browser, folder: Path, problems: list[str]) -> None:
    shutil.rmtree(folder)
    assert clean_preview(folder.parent / "walk.c3d") == folder
    with serve(folder) as running:
        running.session.start_cleaning("walk", {})
        page = open_page(browser, running, problems)
        expect(page.locator("#status")).to_contain_text("This is a preview. Cleaning in full")
        assert get_take(page)["is_preview"]
        rejected = get_selected(page)
        press_and_wait(page, "r")
        expect(page.locator("#status")).to_have_text("Cleaned in full.")
        wait_until_ready(page)
        assert not get_take(page)["is_preview"]
        event = next(each for each in list_events(page) if each["id"] == rejected)
        assert {each["decision"] for each in event["changes"]} == {"reject"}
        page.context.close()
    assert not problems
    assert clean_preview(folder.parent / "walk.c3d") == folder  # it is cleaned, so it stays as it is
    assert (folder / "walk.report.html").is_file()


def test_an_animation_opens_no_dialog_that_would_refuse(browser: Browser, folder: Path, problems: list[str]) -> None:
    animation = folder.parent / "motion"
    animation.mkdir()
    shutil.copy(folder / "walk.bvh", animation / "walk.bvh")
    pipeline.clean(animation / "walk.bvh", prior="none").write(animation / "walk.mocapfix")
    with serve(animation) as running:
        page = open_page(browser, running, problems)
        for key, button in (("w", "#mark"), ("s", "#swap"), ("u", "#assign"), ("g", "#fill")):
            page.keyboard.press(key)
            assert page.locator("dialog[open]").count() == 0
            expect(page.locator("#status")).to_contain_text("not for animations")
            expect(page.locator(button)).to_be_disabled()
        for _ in range(3):
            page.keyboard.press("i")
        expect(page.locator("#curves-quantity")).to_have_value("rotation")
        (take,) = find_cleaned_takes(animation)
        joint = "LeftForeArm"
        page.evaluate("name => review.app.showMarker(review.app.take.labels.indexOf(name))", joint)
        page.wait_for_function("review.app.samples.traces.get(review.app.marker)?.length")
        values = "['before', 'after'].map(layer => review.app.curves.rows.map(row => row.value(layer, review.app.marker, 30)))"
        shown = np.ravel(page.evaluate(values))
        np.testing.assert_allclose(shown, trace_marker(take, load_take_view(take), joint)[30], atol=1e-3)
        page.locator("#curves-quantity").select_option("position")
        page.locator("#curves-quantity").select_option("rotation")
        assert page.evaluate("review.app.curves.rows.length") == 3
        page.context.close()
    assert not problems


def test_a_take_is_approved_in_few_actions(page: Page, running: RunningServer) -> None:
    """A person plays each event above the limit, sees the estimates of the worst, and accepts the rest; an action is a key."""
    limit_mm, actions = page.evaluate("review.app.limit.limitMm"), list[str]()

    def act(key: str, is_edit: bool = False) -> None:
        press_and_wait(page, key) if is_edit else page.keyboard.press(key)
        actions.append(key)

    act("g")
    page.wait_for_selector("#fills button")
    act("Escape")
    while (entry := page.evaluate("review.app.entry")) and not entry["is_reviewed"] and entry["limit_mm"] > limit_mm:
        for key in (" ", " "):
            act(key)
        act("a", is_edit=True)
    act("Shift+A", is_edit=True)
    for key in ("p", *"Ann", "Enter"):
        act(key)
    expect(page.locator("#take-state")).to_have_text("approved by Ann")
    assert all(each["reviewed"] for each in read_changes(running)["changes"])
    assert len(actions) <= 60


def test_pages_on_one_take_see_each_others_decisions(
    page: Page, browser: Browser, running: RunningServer, problems: list[str]
) -> None:
    other = open_page(browser, running, problems)
    name = get_selected(page)
    press_and_wait(page, "r")
    row = other.locator(f'#changes .row[data-id="{name}"]').first
    expect(row).to_have_attribute("data-decision", "reject")
    other.context.close()


def test_pages_on_two_people_see_an_exchange_of_their_labels(
    browser: Browser, cleaned_duo: Path, tmp_path: Path, problems: list[str]
) -> None:
    shutil.copytree(cleaned_duo, tmp_path / "session")
    with serve(tmp_path / "session" / "duo.mocapfix") as running:
        page = open_page(browser, running, problems)
        page.wait_for_function("review.app.scene.people.length === 2 && review.getState().isComplete")
        other_id = page.evaluate("review.app.scene.people[1].take.id")
        running.session.approve(other_id, "Cid")
        other = open_page(browser, running, problems, f"#{other_id}")
        other.wait_for_function("review.app.scene.people.length === 2 && review.getState().isComplete")
        assert get_take(other)["id"] == other_id
        expect(other.locator("#take-state")).to_have_text("approved by Cid")
        before = read_people(other, "after")
        page.keyboard.press("Shift+S")
        page.keyboard.press("ArrowDown")
        press_and_wait(page, "Enter")
        expect(other.locator("#take-state")).not_to_contain_text("approved")
        for name, positions in read_people(page, "after").items():
            assert not np.array_equal(positions, before[name], equal_nan=True)
            np.testing.assert_array_equal(read_people(other, "after")[name], positions)
        press_and_wait(page, "Control+z")
        other.wait_for_function("!review.app.samples.others[0].take.corrections.length")
        for name, positions in read_people(other, "after").items():
            np.testing.assert_array_equal(positions, before[name])
        page.context.close()
        other.context.close()
    assert not problems


def test_edit_of_the_file_by_hand_is_shown_and_kept(page: Page, running: RunningServer, problems: list[str]) -> None:
    path = running.folder / "walk.changes.yaml"
    path.write_text(path.read_text(encoding="utf-8").replace("decision: accept", "decision: keep", 1), encoding="utf-8")
    by_hand = path.read_bytes()
    page.keyboard.press("r")
    expect(page.locator("#status")).to_contain_text("was changed by another page, program or person")
    assert path.read_bytes() == by_hand
    assert [each["decision"] for each in get_take(page)["changes"]].count("keep") == 1
    problems[:] = [text for text in problems if "409" not in text]  # Chromium reports the answer to the refused edit


def test_keys_filters_and_views(page: Page) -> None:
    changes = get_take(page)["changes"]
    page.keyboard.press("?")
    expect(page.locator("#dialog-help")).to_be_visible()
    page.keyboard.press("Escape")
    kind = changes[0]["kind"]
    page.locator("#filter-kind").select_option(kind)
    expect(page.locator("#changes .row").first).to_contain_text(kind)
    page.locator("#filter-kind").select_option("")
    page.locator("#filter-marker").fill("lfin")
    labels = {each["markers"][0] for each in changes if any("LFIN" in label for label in each["markers"])}
    assert page.locator("#changes .row .name").count() > 0
    assert {text.split(" +")[0].split(", ")[0] for text in page.locator("#changes .row .name").all_inner_texts()} <= labels
    page.keyboard.press("r")  # a letter of the filter, not a decision
    assert not any(each["is_reviewed"] for each in get_take(page)["changes"])
    page.locator("#filter-marker").fill("")
    page.locator("#scene").click()
    page.evaluate("document.activeElement.blur()")
    for key in ("1", "2", "3", "f", "0", "b", "v", "l", "o", "PageDown", "PageUp", "End", "Home", "+", "-", "Space", "d"):
        page.keyboard.press(key)
    page.wait_for_function("review.getState().frame > 0")  # it plays
    page.keyboard.press("Space")


def get_joint(page: Page, name: str, frame: int) -> np.ndarray:
    """Return the position of a joint as the page has it."""
    place = "([name, frame]) => review.app.samples.getPosition('joints', frame, review.app.take.joints.indexOf(name))"
    return np.array(page.evaluate(place, [name, frame]))


def get_view_direction(page: Page) -> np.ndarray:
    """Return the level unit vector from what is looked at to the camera."""
    eye = "review.app.scene.camera.position.clone().sub(review.app.scene.controls.target).setY(0).normalize().toArray()"
    return np.array(page.evaluate(eye))


@pytest.mark.parametrize("is_by_mouse", [False, True])
def test_front_and_side_are_those_of_the_performer(page: Page, is_by_mouse: bool) -> None:
    page.wait_for_function("review.getState().isComplete")
    for frame in (20, 220):
        page.evaluate("frame => review.app.playback.moveTo(frame)", frame)
        left = (get_joint(page, "LeftUpLeg", frame) - get_joint(page, "RightUpLeg", frame)) * [1, 0, 1]
        left /= np.linalg.norm(left)
        for key, button, expected in (("1", "#view-front", np.cross(left, [0, 1, 0])), ("2", "#view-side", left)):
            page.locator(button).click() if is_by_mouse else page.keyboard.press(key)
            np.testing.assert_allclose(get_view_direction(page), expected, atol=1e-3)


def list_cut_joints(page: Page) -> int:
    """Return how many joints and cleaned markers are outside the view, or behind its bar."""
    return page.evaluate(
        """() => { const { scene, samples } = review.app, bar = document.querySelector("#view-bar").getBoundingClientRect();
        const { left, width } = scene.labelledPicture, top = bar.bottom - scene.canvas.getBoundingClientRect().top;
        let cut = 0;
        for (const layer of ["after", "joints"]) for (let m = 0; m < samples.counts[layer]; m++) {
            if (!scene.projectTrajectory(layer, m)) continue;
            const { x, y } = scene.point;
            cut += x < left || x > left + width || y < top || y > scene.canvas.clientHeight;
        }
        return cut; }"""
    )


def test_the_whole_body_is_in_the_picture_after_every_jump(page: Page) -> None:
    page.wait_for_function("review.getState().isComplete")
    for size in ((1100, 700), (1440, 900), (2560, 1300)):
        page.set_viewport_size({"width": size[0], "height": size[1]})
        page.wait_for_function("Math.abs(review.app.scene.camera.aspect - scene.clientWidth / scene.clientHeight) < 1e-6")
        for key in ("2", "Home", "End", "PageUp", "f", "Home", "5", "End", "5"):
            page.keyboard.press(key)
            if key != "f":
                assert list_cut_joints(page) == 0, (size, key)
    page.keyboard.press("f")
    box = page.locator("#lanes").bounding_box()
    assert box
    page.mouse.click(box["x"] + 0.5 * box["width"], box["y"] + 6)
    assert list_cut_joints(page) == 0


def test_the_view_follows_the_performer_or_stays(page: Page) -> None:
    page.wait_for_function("review.getState().isComplete")
    eye = "review.app.scene.camera.position.toArray()"
    page.keyboard.press("Home")
    start, place = (
        np.array(page.evaluate(eye)),
        [np.mean([get_joint(page, f"{side}UpLeg", t) for side in ("Left", "Right")], 0) for t in (0, 90)],
    )
    for _ in range(9):
        page.keyboard.press("Shift+ArrowRight")
    moved = (place[1] - place[0]) * [1, 0, 1]
    assert np.linalg.norm(moved) > 0.05
    np.testing.assert_allclose(np.array(page.evaluate(eye)) - start, moved, atol=1e-4)
    page.keyboard.press("4")
    stays = page.evaluate(eye)
    page.keyboard.press("End")
    assert page.evaluate(eye) == stays
    page.locator("#show-follow").check()
    page.keyboard.press("Home")
    assert page.evaluate(eye) != stays


def test_before_is_shown_as_a_ghost_and_beside_after(page: Page) -> None:
    page.wait_for_function("review.getState().isComplete")
    count = "review.app.scene.people[0].layers.before.geometry.drawRange.count"
    known = "review.app.take.labels.filter((_, m) => !isNaN(review.app.samples.getPosition('before', 0, m)[0])).length"
    page.keyboard.press("Home")
    markers = page.evaluate(known)
    assert page.evaluate(count) < markers  # those that were changed only
    for act in (lambda: page.keyboard.press("6"), lambda: page.locator("#show-ghost").uncheck()):
        act()
        is_shown = page.evaluate("review.app.scene.people[0].ghost.isVisible")
        assert (page.evaluate(count) == markers) == is_shown
    assert not is_shown
    page.keyboard.press("5")
    expect(page.locator("#picture-names span")).to_have_text(["before", "after"])
    assert page.evaluate(count) == markers
    stage = page.locator("#scene").bounding_box()
    assert stage
    assert page.evaluate("review.app.scene.projectMarker(0).x") > stage["width"] / 2  # the label stands in the picture of after
    page.locator("#division").select_option("one")
    expect(page.locator("#picture-names")).to_have_text("")
    for key, name in (("7", "body"), ("8", "links"), ("9", "bones")):
        page.keyboard.press(key)
        assert not page.evaluate(f"review.app.scene.people[0].{name}.isVisible")


def test_the_people_of_a_file_are_shown_together_and_beside_each_other(
    browser: Browser, tmp_path: Path, problems: list[str]
) -> None:
    one, other = (compose_take(seed=seed, seconds=3.0, rate=60.0) for seed in (3, 4))
    markers = np.concatenate([one.damaged_positions, other.damaged_positions + [1.6, 0.0, 0.3]], axis=1)
    labels = (*(f"Ann:{label}" for label in one.labels), *(f"Bob:{label}" for label in other.labels))
    write_c3d(tmp_path / "duo.c3d", Take(markers, labels, 60.0))
    pipeline.clean(tmp_path / "duo.c3d", prior="none", is_fast=True).write(tmp_path / "duo.mocapfix")
    with serve(tmp_path / "duo.mocapfix") as running:
        page = open_page(browser, running, problems)
        page.wait_for_function("review.app.scene.people.length === 2")
        expect(page.locator('#division option[value="people"]')).to_be_enabled()
        page.keyboard.press("5")
        page.keyboard.press("5")
        expect(page.locator("#picture-names span")).to_have_count(2)
        names = [take["subject"] for take in page.evaluate("review.app.scene.people.map(each => each.take)")]
        expect(page.locator("#picture-names span")).to_have_text(names)
        assert sorted(names) == ["Ann", "Bob"]
        assert list_cut_joints(page) == 0
        page.context.close()
    assert not problems


# The colours that a person without one kind of cones sees, from linear RGB (Machado and others 2009, severity 1).
COLOUR_VISION = {
    "all cones": np.eye(3),
    "protanopia": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "deuteranopia": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
    "tritanopia": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]],
}
MIN_COLOUR_DISTANCE = 15.0  # in CIELAB; about 2 are just seen side by side


def convert_to_lab(rgb: np.ndarray) -> np.ndarray:
    """Return linear sRGB in CIELAB, white D65."""
    xyz = rgb @ np.array([[0.4124, 0.2126, 0.0193], [0.3576, 0.7152, 0.1192], [0.1805, 0.0722, 0.9505]]) / [0.9505, 1.0, 1.089]
    x, y, z = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16 / 116)
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


@pytest.mark.parametrize("theme", ["dark", "light"])
@pytest.mark.parametrize("vision", COLOUR_VISION)
def test_the_colours_of_markers_differ_for_the_colour_blind(page: Page, theme: str, vision: str) -> None:
    page.evaluate("theme => review.app.applyTheme(theme)", theme)
    names = ["scene", "after", "estimated", "faulty", "relabelled", "unlabelled"]
    colours = page.evaluate("names => names.map(each => review.app.scene.colours[each].toArray())", names)
    seen = {
        name: convert_to_lab(np.clip(COLOUR_VISION[vision] @ np.array(rgb), 0, 1))
        for name, rgb in zip(names, colours, strict=True)
    }
    near = {(a, b): round(float(np.linalg.norm(seen[a] - seen[b]))) for a, b in combinations(names, 2)}
    assert not {pair: distance for pair, distance in near.items() if distance < MIN_COLOUR_DISTANCE}


def test_take_is_approved_by_keyboard(page: Page, running: RunningServer) -> None:
    page.keyboard.press("p")
    page.locator("#approve-name").fill("Ann")
    page.keyboard.press("Enter")
    expect(page.locator("#take-state")).to_have_text("approved by Ann")
    press_and_wait(page, "a")
    expect(page.locator("#take-state")).to_have_text("in review")
    assert (running.folder / "walk.approval.json").is_file()


def test_takes_of_a_session_are_opened_in_turn(browser: Browser, folder: Path, problems: list[str]) -> None:
    shutil.copytree(folder, folder.parent / "second" / "run")
    shutil.copytree(folder, folder.parent / "third")
    worst = folder / "walk.changes.yaml"
    worst.write_text(re.sub(r"predicted_mm: [\d.]+", "predicted_mm: 999.0", worst.read_text(encoding="utf-8"), count=1), "utf-8")
    with serve(folder.parent) as running:
        assert running.session.ids == ["second/run/walk", "third/walk", "walk.mocapfix/walk"]
        running.session.approve("third/walk", "Ann")
        page = open_page(browser, running, problems)
        assert get_take(page)["id"] == "walk.mocapfix/walk"
        page.keyboard.press("t")
        expect(page.locator('#takes .row[data-id="third/walk"]')).to_contain_text("approved")
        page.keyboard.press("Escape")
        page.keyboard.press("n")
        page.wait_for_function("review.getState().take.id === 'second/run/walk'")
        wait_until_ready(page)
        page.keyboard.press("t")
        page.locator('#takes .row[data-id="third/walk"]').click()
        expect(page.locator("#take-state")).to_have_text("approved by Ann")
        wait_until_ready(page)
        page.context.close()
    assert not problems


def test_a_character_moves_beside_the_body(browser: Browser, running: RunningServer, problems: list[str]) -> None:
    body = read_capture(running.folder / "walk.bvh")
    assert isinstance(body, Animation)
    roots = body.compute_local_positions()[:, 0]
    write_gltf(running.folder / "walk.hero.glb", body.skeleton, {0: roots}, body.compute_local_rotations(), body.rate)
    (running.folder / "walk.hero.map.yaml").touch()
    page = open_page(browser, running, problems)
    page.wait_for_function("review.app.scene.character")
    places: list[list[float]] = []
    for frame in (0, 200):
        page.evaluate("frame => review.app.playback.moveTo(frame)", frame)
        places.append(page.evaluate("review.app.scene.character.hips.getWorldPosition(review.app.scene.point).toArray()"))
    page.locator("#character").select_option("")
    page.wait_for_function("!review.app.scene.character")
    page.context.close()
    assert not problems
    moved = roots[200] - roots[0]
    np.testing.assert_allclose(np.subtract(places[1], places[0])[[0, 2]], moved[[0, 2]], atol=0.01)


def test_labels_and_notes_with_html_are_text(browser: Browser, running: RunningServer, problems: list[str]) -> None:
    from mocapfix.io.capture import read_take

    script = "<img src=x onerror=alert(1)><script>document.title='broken'</script>"
    take = read_take(running.folder.parent / "walk.c3d")
    label, frame = take.labels[0], take.first_frame
    change = build_change("gap", (label,), frame, frame + 3, why=script, method=script, decision="accept")
    write_changes_file(running.folder / "walk.changes.yaml", take, [change])
    page = open_page(browser, running, problems)
    page.keyboard.press("m")
    page.locator("#note-text").fill(script)
    press_and_wait(page, "Enter")
    assert page.locator("#change-detail").inner_text().count(script) == 3
    assert page.locator("img, #change-detail script").count() == 0
    assert re.fullmatch(r"walk\.c3d – mocapfix review", page.title())
    page.context.close()
    assert not problems
