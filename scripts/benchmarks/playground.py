"""Speed of the playground in Chromium: first picture, six strokes to ellipses, frames and round trips while it learns.

Needs the extra ``test`` and Debian's chromium.
"""

import argparse
import subprocess
import sys
import time

import numpy as np
from playwright.sync_api import Page, sync_playwright

QUIET = ["--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking"]
PUSHED = 10.0  # s


def until(page: Page, condition: str) -> None:
    """Wait for an expression of the page's state."""
    while not page.evaluate(f"Boolean((({{ state, statistics }}) => {condition})(window.playground))"):
        time.sleep(0.01)


def measure(page: Page, address: str) -> None:
    """Print the figures of one page."""
    begun = time.perf_counter()
    page.goto(address)
    until(page, "state.strokes.length == 6")
    print(f"page with six strokes after       {time.perf_counter() - begun:6.2f} s")
    until(page, "state.schedule")
    print(f"first picture and schedule after  {time.perf_counter() - begun:6.2f} s, with torch loaded meanwhile")
    learned = []
    for name in ("Letter S", "Through a gate", "Reach and insert"):
        page.select_option("#example", name)
        until(page, "statistics.learned > 0")
        learned.append(page.evaluate("(({ statistics }) => statistics.learned - statistics.asked)(window.playground)"))
    print(f"six strokes to ellipses           {np.median(learned) / 1000:6.2f} s")
    until(page, "state.schedule")
    page.keyboard.press("p")
    page.evaluate("window.playground.statistics.trips.length = 0")
    before = page.evaluate("window.playground.statistics.frames")
    page.keyboard.down("ArrowUp")
    start = time.perf_counter()
    while (passed := time.perf_counter() - start) < PUSHED:  # a push, while it learns again and again
        page.select_option("#example", ["Letter S", "Through a gate"][int(passed) % 2])
        time.sleep(0.5)
    frames = page.evaluate("window.playground.statistics.frames") - before
    trips = np.array(page.evaluate("window.playground.statistics.trips"))
    print(f"frames while it learns            {frames / passed:6.1f} a second")
    print(f"round trip, median and 99 %       {np.median(trips):6.1f} ms, {np.quantile(trips, 0.99):.1f} ms")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--chromium", default="/usr/bin/chromium")
    options = parser.parse_args()
    command = [sys.executable, "-m", "torch_pbd.cli.main", "playground", "--browse", "false"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as run, sync_playwright() as playwright:
        assert run.stdout is not None
        address = run.stdout.readline().split()[1]
        browser = playwright.chromium.launch(executable_path=options.chromium, args=QUIET)
        measure(browser.new_page(viewport={"width": 1280, "height": 720}), address)
        browser.close()
        run.terminate()


if __name__ == "__main__":
    main()
