"""The pages of the gallery: pictures of the review page, the report and the session page."""

import subprocess
import sys
import threading
from collections.abc import Generator
from contextlib import chdir, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import yaml
from gallery_scene import Studio, compute_error_mm, save_page
from playwright.sync_api import Page, ViewportSize

from mocapfix.cli.commands import run_demo
from mocapfix.io.capture import read_take
from mocapfix.review.review_session import ReviewSession
from mocapfix.review.server import ReviewServer
from mocapfix.synthetic import compose_take, write_synthetic_take

PIXEL_RATIO = 1.25
REVIEW_SIZE: ViewportSize = {"width": 1280, "height": 800}
CLEANING_TIMEOUT_MS = 300_000
REVIEWED_CHANGE, REVIEWED_MARKER, REVIEWED_FRAMES = "gap-LWRA-121", "LWRA", slice(120, 300)
REPORT_SIZE: ViewportSize = {"width": 1000, "height": 640}
SESSION_SIZES: dict[str, ViewportSize] = {
    "session-page-before": {"width": 1200, "height": 720},
    "session-page": {"width": 1500, "height": 1200},
}
SESSION_TAKES = ("jim/walk", "jim/reach", "ann/walk", "ann/turn")


@contextmanager
def open_review(studio: Studio, folder: Path) -> Generator[Page]:
    """Serve the review of a cleaned take, and yield its page once it is complete."""
    server = ReviewServer(ReviewSession(folder))
    thread = threading.Thread(target=server.serve, daemon=True)
    thread.start()
    # Playwright evaluates expressions, which the page's policy forbids.
    context = studio.browser.new_context(
        viewport=REVIEW_SIZE, device_scale_factor=PIXEL_RATIO, bypass_csp=True, color_scheme="dark"
    )
    page = context.new_page()
    page.goto(server.address)
    page.wait_for_function("review.getState().isComplete")
    yield page
    context.close()
    server.stop()
    thread.join()


def make_review_page(studio: Studio) -> str:
    """Take pictures of the review page before and after a technician rejects a fill, and return the caption."""
    truth = compose_take()  # that of the demo
    marker = truth.labels.index(REVIEWED_MARKER)
    with TemporaryDirectory() as folder, chdir(folder):
        run_demo()
        take_report_picture(studio, Path("demo.mocapfix/demo.report.html"))
        fill_m = read_take("demo.mocapfix/demo.c3d").markers[REVIEWED_FRAMES, marker]
        error_mm = compute_error_mm(fill_m, truth.marker_positions[REVIEWED_FRAMES, marker])
        with open_review(studio, Path("demo.mocapfix")) as page:
            find_predicted = "name => review.getState().take.changes.find(each => each.id === name).predicted_mm"
            predicted_mm = page.evaluate(find_predicted, REVIEWED_CHANGE)
            for name in ("review-page", "review-page-after"):
                page.evaluate("name => review.app.select(name)", REVIEWED_CHANGE)
                page.evaluate("review.app.scene.frameMarkers(null, [0.7, 0.2, 1])")
                page.wait_for_timeout(1000)
                save_page(name, page)
                if name == "review-page":
                    page.keyboard.press("g")
                    page.wait_for_selector("#fills button", timeout=CLEANING_TIMEOUT_MS)
                    page.wait_for_timeout(1000)
                    save_page("review-fills", page)
                    page.keyboard.press("Escape")
                    page.keyboard.press("r")
                    page.wait_for_function("review.getState().take.changes.some(each => each.is_reviewed)")
                    page.keyboard.press("c")
                    page.wait_for_function("document.body.innerText.includes('Cleaned again')", timeout=CLEANING_TIMEOUT_MS)
                    page.wait_for_timeout(2000)
    return (
        "The fills of a lost arm are the least certain ones, so they come first: for this marker of the wrist mocapfix predicts "
        f"an error of {predicted_mm:.0f} mm; it is {error_mm:.0f} mm from the truth. The technician rejects the fill with R and "
        "cleans again with C: the marker is empty there, as it was recorded, and nothing else has changed."
    )


def take_report_picture(studio: Studio, report: Path) -> None:
    """Take a picture of the first of the largest changes in a report, for the tutorial."""
    page = studio.browser.new_page(viewport=REPORT_SIZE, device_scale_factor=PIXEL_RATIO)
    page.goto(report.resolve().as_uri())
    page.get_by_role("heading", name="Largest changes").evaluate("heading => heading.scrollIntoView()")
    save_page("report", page)
    page.close()


def make_session_page(studio: Studio) -> str:
    """Take pictures of the page of a session before and after a damaged take was exported again, and return the caption."""
    page = studio.browser.new_page(device_scale_factor=PIXEL_RATIO)
    with TemporaryDirectory() as folder, chdir(folder):
        takes = [Path(f"{name}.c3d") for name in SESSION_TAKES]
        for n, take in enumerate(takes):
            take.parent.mkdir(exist_ok=True)
            write_synthetic_take(take, compose_take(seed=20 + n // 2, seconds=5.0 + n, rate=100.0))
        session = {"kind": "session", "title": "Monday, two actors", "takes": ["*/*.c3d"]}
        Path("monday.yaml").write_text(yaml.safe_dump(session), encoding="utf-8")
        sound = takes[-1].read_bytes()
        takes[-1].write_bytes(sound[: len(sound) // 3])
        for picture, size in SESSION_SIZES.items():
            subprocess.run([sys.executable, "-m", "mocapfix", "batch", "monday.yaml", "--out", "cleaned"], check=False)
            page.set_viewport_size(size)
            page.goto(Path("cleaned/index.html").resolve().as_uri())
            # the path of the temporary folder is of no interest
            page.evaluate("path => { document.body.innerHTML = document.body.innerHTML.replaceAll(path, ''); }", f"{Path.cwd()}/")
            save_page(picture, page)
            takes[-1].write_bytes(sound)
    page.close()
    return (
        "A file is cut off, so one of four takes is refused, with a sentence that says why; the others are cleaned. After it "
        "is exported again, the same command cleans what is missing. Each row has the predicted errors and the worst moment."
    )
