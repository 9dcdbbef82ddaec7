"""The review page of a long take in Chromium: times until it can be used and of edits, pictures a second, the server's memory."""

import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import psutil

from mocapfix.errors import ReadError
from mocapfix.io.c3d import write_c3d
from mocapfix.model.take import Take
from mocapfix.synthetic import compose_take

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page


MARKER_COUNT, RATE_HZ, TAKE_S = 57, 60.0, 600.0
LOAD_COUNT, EDIT_COUNT, JUMP_COUNT = 5, 21, 21
PLAY_S = 4.0
# Selects the next change, and draws until the picture is complete; returns the time in ms.
JUMP = """() => { const { app } = review, start = performance.now(), gl = app.scene.renderer.getContext();
  app.selectNeighbour(1); app.scene.renderIfNeeded(); gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
  return performance.now() - start; }"""
# Zooms the curves from the whole take to a part and back for some seconds; returns the pictures a second.
ZOOM = """async (seconds) => { const { curves, lastFrame } = review.app, end = performance.now() + 1000 * seconds; let count = 0;
  curves.window.show(0, lastFrame);
  for (; performance.now() < end; count++) {
    curves.window.zoom(count % 40 < 20 ? 0.8 : 1.25, lastFrame / 2);
    await new Promise(requestAnimationFrame);
  }
  return count / seconds; }"""
NEIGHBOUR_DISTANCE_M = 0.03  # of the markers beyond those of the composed body from markers on it
CHROMIUM_ARGUMENTS = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
CHROMIUM_NAMES = ("chromium", "chromium-browser", "google-chrome")
ADDRESS_PATTERN = re.compile(r"http://\S+")


def find_chromium() -> str:
    """Return the path of Chromium. Raises ReadError if it is not installed."""
    for name in CHROMIUM_NAMES:
        if path := shutil.which(name):
            return path
    raise ReadError("The review page is measured in Chromium, which is not installed; install it with: make browser.")


class RunningReview:
    """A `mocapfix review` of a folder, in a process of its own."""

    def __init__(self, folder: Path) -> None:
        command, self.start_s = [sys.executable, "-m", "mocapfix", "review", str(folder), "--no-browser"], time.perf_counter()
        self.process = psutil.Popen(command, stdout=subprocess.PIPE, encoding="utf-8")
        assert self.process.stdout
        match = ADDRESS_PATTERN.search(self.process.stdout.readline())
        assert match
        self.address = match[0]

    def close(self) -> None:
        """End the server."""
        self.process.terminate()
        self.process.wait()


def measure_review(folder: Path, report: Callable[[str], None]) -> dict[str, float]:
    """Measure the page on a composed take, which is written and cleaned in a folder. Raises ReadError without Chromium.

    Figures are medians. Processor times do not depend on what else the computer does.
    """
    from playwright.sync_api import sync_playwright

    chromium, outputs = find_chromium(), clean_long_take(folder, report)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=list(CHROMIUM_ARGUMENTS))
        report("page")
        review = RunningReview(outputs)
        page = new_page(browser)
        open_review(page, review.address)
        # from the start of the server until the page can be used
        figures = {"first_ready_s": time.perf_counter() - review.start_s, "server_cpu_s": sum(review.process.cpu_times()[:2])}
        page.wait_for_function("review.getState().isComplete", timeout=300_000)
        figures["server_memory_mb"] = review.process.memory_info().rss / 1e6  # of 10^6 bytes, after all samples were sent
        figures["changes"] = int(page.evaluate("review.getState().take.changes.length"))
        openings = [measure_opening(browser, review.address) for _ in range(LOAD_COUNT)]
        figures["ready_s"], figures["page_cpu_s"] = np.median(openings, axis=0)  # of a page that is opened later
        # from sending a decision to the end of the answer that it is saved, and until the page shows it
        figures["saved_ms"], figures["shown_ms"] = np.median([measure_edit(page) for _ in range(EDIT_COUNT)], axis=0)
        read_cpu_s = watch_processor(page)
        figures["jump_ms"] = np.median([page.evaluate(JUMP) for _ in range(JUMP_COUNT)])
        figures["jump_cpu_ms"], start_s = 1e3 * read_cpu_s() / JUMP_COUNT, read_cpu_s()
        figures["zooms_per_s"] = page.evaluate(ZOOM, PLAY_S)
        figures["zoom_cpu_ms"] = 1e3 * (read_cpu_s() - start_s) / (PLAY_S * figures["zooms_per_s"])  # of a picture
        figures["frames_per_s"] = measure_playing(page)
        review.close()
        browser.close()
    return {name: round(float(value), 2) for name, value in figures.items()}


def new_page(browser: "Browser") -> "Page":
    """Return a page in which expressions can be evaluated, which the policy of the review forbids."""
    return browser.new_context(viewport={"width": 1280, "height": 800}, bypass_csp=True).new_page()


def measure_opening(browser: "Browser", address: str) -> tuple[float, float]:
    """Return the time until a new page shows the take and its changes, and the processor time of its main thread, in seconds."""
    page = new_page(browser)
    read_cpu_s = watch_processor(page)
    times_s = open_review(page, address), read_cpu_s()
    page.context.close()
    return times_s


def watch_processor(page: "Page") -> Callable[[], float]:
    """Return a function that returns the processor time in seconds of the main thread of a page, from now on."""
    tools = page.context.new_cdp_session(page)
    tools.send("Performance.enable", {"timeDomain": "threadTicks"})
    return lambda: {each["name"]: each["value"] for each in tools.send("Performance.getMetrics")["metrics"]}["TaskDuration"]


def open_review(page: "Page", address: str) -> float:
    """Open the page; return the time in seconds until it shows the take and its changes."""
    start = time.perf_counter()
    page.goto(address)
    page.wait_for_selector('html[data-ready="1"]', timeout=300_000)
    return time.perf_counter() - start


def measure_edit(page: "Page") -> tuple[float, float]:
    """Reject or keep the selected change; return the times in ms until the answer has come, and until the page shows it."""
    revision, decision = page.evaluate("[review.getState().take.revision, review.app.change.decision]")
    page.keyboard.press("k" if decision == "reject" else "r")
    page.wait_for_function("revision => review.getState().take.revision !== revision", arg=revision)
    saved_ms = page.evaluate(
        "performance.getEntriesByType('resource').filter(each => each.name.endsWith('/edit')).at(-1).duration"
    )
    return float(saved_ms), float(page.evaluate("review.app.edits.lastDurationMs"))


def measure_playing(page: "Page") -> float:
    """Play the take; return the pictures a second after the first second."""
    page.keyboard.press("Home")
    page.keyboard.press("Space")
    time.sleep(PLAY_S)
    frames_per_s = float(page.evaluate("review.getFrameRate()"))
    page.keyboard.press("Space")
    return frames_per_s


def clean_long_take(folder: Path, report: Callable[[str], None]) -> Path:
    """Write and clean a damaged take, unless this was done before; return the folder of its outputs."""
    path = folder / f"{TAKE_S:.0f}s.c3d"
    outputs = path.with_suffix(".mocapfix")
    if not outputs.is_dir():
        report(f"clean {path.name}")
        folder.mkdir(parents=True, exist_ok=True)
        truth = compose_take(seconds=TAKE_S, rate=RATE_HZ)
        positions = truth.damaged_positions
        count = MARKER_COUNT - len(truth.labels)  # of markers beside those of the composed body
        positions = np.concatenate([positions, positions[:, :count] + [0.0, NEIGHBOUR_DISTANCE_M, 0.0]], axis=1)
        write_c3d(path, Take(positions, (*truth.labels, *(f"EXTRA{n}" for n in range(count))), RATE_HZ))
        command = [sys.executable, "-m", "mocapfix", "clean", str(path), "--fast", "--out", str(outputs), "--overwrite"]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return outputs
