"""The review page in Chromium: everything by keyboard, and the files that this leaves."""

import re
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from playwright.sync_api import Browser, Page, expect, sync_playwright

from mocapfix.io.capture import read_capture
from mocapfix.io.changes_file import write_changes_file
from mocapfix.io.gltf import write_gltf
from mocapfix.model.animation import Animation
from mocapfix.review.review_session import ReviewSession
from mocapfix.review.server import ReviewServer
from tests.io.read_back import motion_of
from tests.io.test_changes_file import build_change
from tests.review.conftest import RunningServer

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


def open_page(browser: Browser, running: RunningServer, problems: list[str]) -> Page:
    # Playwright evaluates expressions, which the page's policy forbids. test_server checks the policy.
    context = browser.new_context(viewport={"width": 1280, "height": 800}, bypass_csp=True)
    page = context.new_page()
    page.set_default_timeout(WAIT_MS)
    page.on("pageerror", lambda error: problems.append(str(error)))
    page.on("console", lambda message: problems.append(message.text) if message.type == "error" else None)
    page.on("request", lambda sent: problems.append(sent.url) if "127.0.0.1" not in sent.url and ":" in sent.url[:6] else None)
    page.goto(f"{running.address}/")
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


def select_change(page: Page, name: str) -> None:
    page.evaluate("name => review.app.select(name)", name)


def read_changes(running: RunningServer) -> dict[str, Any]:
    return yaml.safe_load((running.folder / "walk.changes.yaml").read_text(encoding="utf-8"))


def test_a_take_is_reviewed_by_keyboard_and_cleaned_again(page: Page, running: RunningServer) -> None:
    take = get_take(page)
    expect(page.locator("#take-state")).to_have_text("untouched")
    seen: list[str] = []
    for _ in take["changes"]:  # step through all changes: the least certain first, each in its middle
        seen.append(get_selected(page))
        change = next(each for each in take["changes"] if each["id"] == seen[-1])
        assert page.evaluate("review.getState().frame") == (change["first"] + change["last"]) // 2 - take["first_frame"]
        assert page.locator('#changes .row[aria-selected="true"]').get_attribute("data-id") == seen[-1]
        page.keyboard.press("ArrowDown")
    assert sorted(seen) == sorted(each["id"] for each in take["changes"])
    predicted = {each["id"]: each["predicted_mm"] for each in take["changes"]}
    known = [predicted[name] for name in seen if predicted[name] is not None]
    assert known == sorted(known, reverse=True)

    one, two, three, four = seen[:4]
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

    expected = running.folder.parent / "expected"
    shutil.copytree(running.folder, expected)
    page.keyboard.press("c")
    page.wait_for_selector("#difference:not([hidden])")
    wait_until_ready(page)
    expect(page.locator("#difference")).to_contain_text("differ from the cleaning before")
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


def test_pages_on_one_take_see_each_others_decisions(
    page: Page, browser: Browser, running: RunningServer, problems: list[str]
) -> None:
    other = open_page(browser, running, problems)
    name = get_selected(page)
    press_and_wait(page, "r")
    row = other.locator(f'#changes .row[data-id="{name}"]')
    expect(row).to_have_attribute("data-decision", "reject")
    other.context.close()


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
    assert set(page.locator("#changes .row span:nth-child(2)").all_inner_texts()) <= labels | {"No change passes the filters."}
    page.keyboard.press("r")  # a letter of the filter, not a decision
    assert not any(each["is_reviewed"] for each in get_take(page)["changes"])
    page.locator("#filter-marker").fill("")
    page.locator("#scene").click()
    page.evaluate("document.activeElement.blur()")
    for key in ("1", "2", "3", "f", "0", "b", "v", "l", "o", "PageDown", "PageUp", "End", "Home", "+", "-", "Space", "d"):
        page.keyboard.press(key)
    page.wait_for_function("review.getState().frame > 0")  # it plays
    page.keyboard.press("Space")
    page.keyboard.press("Shift+A")
    page.keyboard.press("Enter")
    page.wait_for_function("review.getState().take.changes.some(each => each.is_reviewed)")
    selected = next(each for each in changes if each["id"] == get_selected(page))
    take = get_take(page)
    assert {each["kind"] for each in take["changes"] if each["is_reviewed"]} == {selected["kind"]}


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
    session = ReviewSession(folder.parent)
    assert session.ids == ["second/run/walk", "third/walk", "walk.mocapfix/walk"]
    session.approve("third/walk", "Ann")
    server = ReviewServer(session)
    thread = threading.Thread(target=server.serve, daemon=True)
    thread.start()
    page = open_page(browser, RunningServer(server.address.rstrip("/"), folder, session, server), problems)
    assert get_take(page)["id"] == "second/run/walk"
    page.keyboard.press("t")
    expect(page.locator('#takes .row[data-id="third/walk"]')).to_contain_text("approved")
    page.keyboard.press("Escape")
    page.keyboard.press("n")
    page.wait_for_function("review.getState().take.id === 'walk.mocapfix/walk'")
    wait_until_ready(page)
    page.keyboard.press("t")
    page.locator('#takes .row[data-id="third/walk"]').click()
    expect(page.locator("#take-state")).to_have_text("approved by Ann")
    wait_until_ready(page)
    page.context.close()
    server.stop()
    thread.join(10.0)
    assert not thread.is_alive()
    assert not problems


def test_a_character_moves_beside_the_body(browser: Browser, running: RunningServer, problems: list[str]) -> None:
    body = read_capture(running.folder / "walk.bvh")
    assert isinstance(body, Animation)
    roots = body.compute_local_positions()[:, 0]
    write_gltf(running.folder / "walk.hero.glb", body.skeleton, motion_of(body.compute_local_rotations(), roots), body.rate)
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
