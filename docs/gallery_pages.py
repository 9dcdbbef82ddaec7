"""The pages of the gallery: pictures of the review page, the report and the session page."""

import io
import subprocess
import sys
import threading
from collections.abc import Callable, Generator
from contextlib import chdir, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

import yaml
from gallery_scene import PAGE_FRAME, PICTURES, Studio, compute_error_mm, save_page
from PIL import Image
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
VIEW_SIZE: ViewportSize = {"width": 1440, "height": 900}
VIEW_PX, VIEW_GAP_PX, VIEW_QUALITY = (720, 450), 8, 70  # of the picture of six views
LANE_PX = 13  # height of a lane
SESSION_SEEDS = (3, 4, 5)
SESSION_TAKES = ("jim/walk", "jim/reach", "ann/walk", "ann/turn")


@contextmanager
def open_review(
    studio: Studio, folder: Path, theme: Literal["dark", "light"] = "dark", size: ViewportSize = REVIEW_SIZE
) -> Generator[Page]:
    """Serve the review of a cleaned take or a batch, and yield its page once it is complete."""
    server = ReviewServer(ReviewSession(folder))
    thread = threading.Thread(target=server.serve, daemon=True)
    thread.start()
    # Playwright evaluates expressions, which the page's policy forbids.
    context = studio.browser.new_context(viewport=size, device_scale_factor=PIXEL_RATIO, bypass_csp=True, color_scheme=theme)
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


def make_review_views(studio: Studio, write_animation: Callable[[Path], object]) -> str:
    """Put six views of the review page into one picture, in dark and light, and return the caption."""
    width, height = VIEW_PX
    composed = Image.new("RGB", (2 * width + VIEW_GAP_PX, 3 * height + 2 * VIEW_GAP_PX), PAGE_FRAME)

    def add(page: Page, place: int) -> None:
        page.wait_for_timeout(1500)
        picture = Image.open(io.BytesIO(page.screenshot())).convert("RGB").resize(VIEW_PX, Image.Resampling.LANCZOS)
        composed.paste(picture, (place % 2 * (width + VIEW_GAP_PX), place // 2 * (height + VIEW_GAP_PX)))

    with TemporaryDirectory() as folder, chdir(folder):
        run_demo()
        Path("takes").mkdir()
        for seed in SESSION_SEEDS:
            write_synthetic_take(Path(f"takes/walk{seed}.c3d"), compose_take(seed=seed, seconds=5.0, rate=100.0))
        write_animation(Path("reach.bvh"))
        for command in (["batch", "takes", "--out", "session"], ["clean", "reach.bvh"]):
            subprocess.run([sys.executable, "-m", "mocapfix", *command], check=True)
        with open_review(studio, Path("demo.mocapfix"), "dark", VIEW_SIZE) as page:
            page.evaluate("name => review.app.select(name)", REVIEWED_CHANGE)
            add(page, 0)
            page.keyboard.press("z")
            add(page, 2)
        with open_review(studio, Path("demo.mocapfix"), "light", VIEW_SIZE) as page:
            page.evaluate("name => review.app.select(name)", REVIEWED_CHANGE)
            bounds = page.locator("#lanes").bounding_box()
            assert bounds
            page.keyboard.down("Control")
            for row in range(1, 4):
                page.mouse.click(bounds["x"] + bounds["width"] / 2, bounds["y"] + (row + 0.5) * LANE_PX)
            page.keyboard.up("Control")
            add(page, 1)
            page.keyboard.press("g")
            page.wait_for_selector("#fills button", timeout=CLEANING_TIMEOUT_MS)
            best = page.locator("#fills .best").inner_text()
            add(page, 3)
        with open_review(studio, Path("session"), "dark", VIEW_SIZE) as page:
            page.keyboard.press("t")
            add(page, 4)
        with open_review(studio, Path("reach.mocapfix"), "light", VIEW_SIZE) as page:
            add(page, 5)
    composed.save(PICTURES / "review-views.webp", quality=VIEW_QUALITY, method=6)
    predicted_mm = float(best.split()[-2])
    return (
        "Left: a take after opening, lanes around the selection, and the takes of a session. Right: the curves of two markers, "
        f"the estimates of a gap, the best of which has a predicted error of {predicted_mm:.0f} mm, and an animation. The page "
        "is dark or light."
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
