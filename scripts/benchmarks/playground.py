"""Speed of the playground in Chromium: first picture, six strokes to ellipses, frames and round trips while it learns.

Needs the extra ``test`` and Debian's chromium.
"""

import argparse
import signal
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


def measure(page: Page, address: str, begun: float) -> None:
    """Print the figures of one page of a playground begun at a time in s."""
    page.goto(address)
    until(page, "state.measured && statistics.frames > 1")
    print(f"strokes, their mean and ellipses  {time.perf_counter() - begun:6.2f} s after the command")
    until(page, "state.schedule")
    print(f"first model and a robot to push   {time.perf_counter() - begun:6.2f} s after it, as torch is loaded")
    learned = []
    for name in 3 * ("Letter S", "Through a gate", "Reach and insert"):
        page.select_option("#example", name)
        until(page, "statistics.learned > 0")
        learned.append(page.evaluate("(({ statistics }) => statistics.learned - statistics.asked)(window.playground)"))
    print(f"six strokes to a model's ellipses {np.median(learned) / 1000:6.2f} s, largest {max(learned) / 1000:.2f} s")
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
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=options.chromium, args=QUIET)
        page, begun = browser.new_page(viewport={"width": 1280, "height": 720}), time.perf_counter()
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as run:
            assert run.stdout is not None
            measure(page, run.stdout.readline().split()[1], begun)
            run.send_signal(signal.SIGINT)
        browser.close()


if __name__ == "__main__":
    main()
