"""Write the picture of the review page: `python docs/generate_review_picture.py`. Needs Chromium (`make browser`).

The take is that of the demo, at a moment when an arm is lost. The page is in dark colours; with the argument "light" it is in
light ones.
"""

import sys
import threading
from contextlib import chdir
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

from PIL import Image
from playwright.sync_api import sync_playwright

from mocapfix.cli.app import run_demo
from mocapfix.lab.review_page import CHROMIUM_ARGUMENTS, find_chromium
from mocapfix.review.review_session import ReviewSession
from mocapfix.review.server import ReviewServer

TARGET = Path(__file__).parent.resolve() / "review-page.png"
CHANGE = "gap-LWRA-121"
PICTURE_COLOURS = 256


def write_picture(theme: Literal["dark", "light"], target: Path) -> None:
    """Write the picture of the page, in the colours "dark" or "light"."""
    with TemporaryDirectory() as folder, chdir(folder), sync_playwright() as playwright:
        run_demo()
        server = ReviewServer(ReviewSession(Path("demo.mocapfix")))
        thread = threading.Thread(target=server.serve, daemon=True)
        thread.start()
        browser = playwright.chromium.launch(executable_path=find_chromium(), args=list(CHROMIUM_ARGUMENTS))
        context = browser.new_context(viewport={"width": 1280, "height": 800}, bypass_csp=True, color_scheme=theme)
        page = context.new_page()
        page.goto(server.address)
        page.wait_for_function("review.getState().isComplete")
        page.keyboard.press("a")
        page.wait_for_function("review.getState().take.changes.some(each => each.is_reviewed)")
        page.evaluate("name => review.app.select(name)", CHANGE)
        page.evaluate("review.app.scene.frameMarkers(null, [0.7, 0.25, 1])")
        page.wait_for_timeout(500)
        page.screenshot(path=target)
        browser.close()
        server.stop()
        thread.join()
    picture = Image.open(target).convert("RGB")
    picture.quantize(PICTURE_COLOURS, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE).save(target, optimize=True)


if __name__ == "__main__":
    write_picture("light" if "light" in sys.argv[1:] else "dark", TARGET)
