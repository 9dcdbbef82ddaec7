"""The review page in Chromium: the time until it can be used, the time of an edit, pictures a second, and the server's memory."""

import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, TypedDict

import numpy as np
import psutil

from mocapfix.errors import ReadError
from mocapfix.io.c3d import write_c3d
from mocapfix.model.take import Take
from mocapfix.synthetic import compose_take

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page


MARKER_COUNT = 53
RATE_HZ = 60.0
PAGE_TAKE_S, MEMORY_TAKE_S = 60.0, 600.0
LOAD_COUNT, EDIT_COUNT = 5, 21
PLAY_S = 4.0
NEIGHBOUR_DISTANCE_M = 0.03  # of the markers beyond those of the composed body from markers on it
CHROMIUM_ARGUMENTS = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
CHROMIUM_NAMES = ("chromium", "chromium-browser", "google-chrome")
ADDRESS_PATTERN = re.compile(r"http://\S+")


class ReviewFigures(TypedDict):
    """Medians."""

    ready_s: float
    saved_ms: float  # from sending a decision to the end of the answer that it is saved
    shown_ms: float  # the same until the page shows it
    frames_per_s: float
    server_memory_mb: float  # of 10^6 bytes, after all samples of the longer take were sent


def find_chromium() -> str:
    """Return the path of Chromium. Raises ReadError if it is not installed."""
    for name in CHROMIUM_NAMES:
        if path := shutil.which(name):
            return path
    raise ReadError("The review page is measured in Chromium, which is not installed; install it with: make browser.")


class RunningReview:
    """A `mocapfix review` of a folder, in a process of its own."""

    def __init__(self, folder: Path) -> None:
        command = [sys.executable, "-m", "mocapfix", "review", str(folder), "--no-browser"]
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, encoding="utf-8")
        assert self._process.stdout
        match = ADDRESS_PATTERN.search(self._process.stdout.readline())
        assert match
        self.address = match[0]

    def measure_memory_mb(self) -> float:
        """Return the resident memory of the server."""
        return psutil.Process(self._process.pid).memory_info().rss / 1e6

    def close(self) -> None:
        """End the server."""
        self._process.terminate()
        self._process.wait()


def measure_review(folder: Path, report: Callable[[str], None]) -> ReviewFigures:
    """Measure the page on composed takes, which are written and cleaned in a folder. Raises ReadError without Chromium."""
    from playwright.sync_api import sync_playwright

    chromium = find_chromium()
    folders = {duration_s: clean_composed_take_of(folder, duration_s, report) for duration_s in (PAGE_TAKE_S, MEMORY_TAKE_S)}
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=list(CHROMIUM_ARGUMENTS))
        report("page")
        review = RunningReview(folders[PAGE_TAKE_S])
        ready_s = [measure_opening(browser, review.address) for _ in range(LOAD_COUNT)]
        page = new_page(browser)
        open_review(page, review.address)
        edits = [measure_edit(page) for _ in range(EDIT_COUNT)]
        frames_per_s = measure_playing(page)
        page.context.close()
        review.close()
        report("memory")
        review = RunningReview(folders[MEMORY_TAKE_S])
        page = new_page(browser)
        open_review(page, review.address)
        page.wait_for_function("review.getState().isComplete", timeout=300_000)
        memory_mb = review.measure_memory_mb()
        review.close()
        browser.close()
    return {
        "ready_s": round(median(ready_s), 2),
        "saved_ms": round(median(saved_ms for saved_ms, _ in edits), 1),
        "shown_ms": round(median(shown_ms for _, shown_ms in edits), 1),
        "frames_per_s": round(frames_per_s, 1),
        "server_memory_mb": round(memory_mb, 1),
    }


def new_page(browser: "Browser") -> "Page":
    """Return a page in which expressions can be evaluated, which the policy of the review forbids."""
    return browser.new_context(viewport={"width": 1280, "height": 800}, bypass_csp=True).new_page()


def measure_opening(browser: "Browser", address: str) -> float:
    """Return the time in seconds until a new page shows the take and its changes."""
    page = new_page(browser)
    ready_s = open_review(page, address)
    page.context.close()
    return ready_s


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


def clean_composed_take_of(folder: Path, duration_s: float, report: Callable[[str], None]) -> Path:
    """Write and clean a damaged take of this duration, unless this was done before; return the folder of its outputs."""
    path = folder / f"{duration_s:.0f}s.c3d"
    outputs = path.with_suffix(".mocapfix")
    if not outputs.is_dir():
        report(f"clean {path.name}")
        folder.mkdir(parents=True, exist_ok=True)
        write_c3d(path, add_markers(duration_s))
        command = [sys.executable, "-m", "mocapfix", "clean", str(path), "--out", str(outputs), "--overwrite"]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return outputs


def add_markers(duration_s: float) -> Take:
    """Return a damaged take of MARKER_COUNT markers: those of a composed body, and others beside some of them."""
    truth = compose_take(seconds=duration_s, rate=RATE_HZ)
    count = MARKER_COUNT - len(truth.labels)
    beside = truth.damaged_positions[:, :count] + [0.0, NEIGHBOUR_DISTANCE_M, 0.0]
    labels = (*truth.labels, *(f"EXTRA{n}" for n in range(count)))
    return Take(np.concatenate([truth.damaged_positions, beside], axis=1), labels, RATE_HZ)
