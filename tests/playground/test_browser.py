"""The page in a real browser: strokes, ellipses, a via point, pushes, files; two tabs; and nothing from elsewhere."""

import json
import shutil
import time

import numpy as np
import pytest

from torch_pbd.control import Schedule, simulate

api = pytest.importorskip("playwright.sync_api", reason="the extra 'test' is not installed")
CHROMIUM = shutil.which("chromium")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium: apt install chromium"),
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),  # Playwright's own
]
QUIET = ["--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking"]
PATIENCE = 240.0  # s: of a loaded machine


@pytest.fixture(scope="module")
def browser():
    with api.sync_playwright() as playwright:
        running = playwright.chromium.launch(executable_path=CHROMIUM, args=QUIET)
        yield running
        running.close()


@pytest.fixture
def page(browser, address):
    yield from opened(browser, address)


def opened(browser, address, **options):
    page = browser.new_page(viewport={"width": 1280, "height": 720}, **options)
    problems, foreign = [], []
    page.on("pageerror", lambda error: problems.append(str(error)))
    page.on(
        "request", lambda request: foreign.append(request.url) if address.split("/")[2] not in request.url else None
    )
    page.goto(address)
    yield page
    page.close()
    assert not problems
    assert not foreign


def wait(page, condition):
    """Until an expression of the page's state is true; its policy forbids what Playwright would do."""
    until = time.monotonic() + PATIENCE
    while not page.evaluate(f"Boolean((({{ state, statistics }}) => {condition})(window.playground))"):
        assert time.monotonic() < until, condition
        page.wait_for_timeout(30)


def state(page, expression):
    return page.evaluate(f"(({{ state, statistics }}) => {expression})(window.playground)")


def at(page, x, y):
    """Pixel of a place of the world, in m."""
    box = page.locator("#scene").bounding_box()
    scale = min((box["width"] - 30) / 0.9, (box["height"] - 30) / 0.6)
    left, bottom = box["x"] + (box["width"] - scale * 0.9) / 2, box["y"] + (box["height"] + scale * 0.6) / 2
    return left + scale * x, bottom - scale * y


def draw(page, off):
    """A stroke from left to right, ``off`` in the middle."""
    places = [(0.1 + 0.7 * i / 25, 0.3 + 4 * off * i / 25 * (1 - i / 25)) for i in range(26)]
    page.mouse.move(*at(page, *places[0]))
    page.mouse.down()
    for place in places[1:]:
        page.mouse.move(*at(page, *place))
        page.wait_for_timeout(20)
    page.mouse.up()


def test_ellipses_of_the_strokes_themselves_do_not_wait_for_a_model(page):
    strokes, measured = state(page, "state.strokes.map((stroke) => stroke.rows)"), state(page, "state.measured")
    share = np.linspace(0.0, 1.0, len(measured["path"]))
    places = [[np.interp(share * rows[-1][0], *np.transpose(rows)[[0, k]]) for k in (1, 2)] for rows in strokes]
    np.testing.assert_allclose(measured["path"], np.mean(places, axis=0).T, rtol=1e-9)
    covariance = [np.cov(np.array(places)[:, :, i].T)[[0, 0, 1], [0, 1, 1]] for i in range(len(share))]
    np.testing.assert_allclose(measured["covariance"], covariance, rtol=1e-9, atol=1e-15)


def test_six_strokes_and_the_way_home(page, tmp_path):
    page.select_option("#model-0", "CholeskyCovRegressor")
    page.click("#clear")
    page.keyboard.press("d")
    for off in (-0.06, 0.05, -0.02, 0.03, 0.06, -0.05):
        draw(page, off)
    wait(page, "state.shown.length && state.schedule && state.strokes.length == 6")
    widths = state(page, "state.pictures[state.shown[0]].covariance.map((row) => row[2])")
    assert max(widths[20:30]) > 4 * max(widths[0], widths[-1])  # free in the middle
    page.screenshot(path=tmp_path / "learned.png")
    for name, size in (("schedule.npz", 1000), ("skill.py", 100)):
        with page.expect_download() as download:
            page.click(f"text={name}")
        download.value.save_as(tmp_path / name)
        assert (tmp_path / name).stat().st_size > size
    assert Schedule.load(tmp_path / "schedule.npz").n_outputs == 2


def test_a_via_point_is_met_and_the_robot_gives_way_where_strokes_differ(page):
    page.select_option("#example", "Letter S")
    wait(page, "state.shown.length && state.schedule")
    page.keyboard.press("b")
    middle = state(page, "state.pictures[state.shown[0]].path[25]")
    page.mouse.move(*at(page, *middle))
    page.mouse.down()
    page.mouse.move(*at(page, middle[0], middle[1] + 0.05), steps=5)
    page.mouse.up()
    wait(
        page,
        "state.via.length == 1 && Math.abs(state.pictures[state.shown[0]].path[25][1] - state.via[0].point[1]) < 2e-3",
    )
    page.keyboard.press("Backspace")
    wait(page, "state.via.length == 0")

    page.keyboard.press("p")
    peaks = []
    for share in (0.0, 0.45):  # precise at the start, free in the middle
        wait(page, f"state.robot.time < {share} * state.schedule.duration + 0.05")
        wait(page, f"state.robot.time > {share} * state.schedule.duration + 0.05")
        page.keyboard.down("ArrowLeft")
        wait(page, f"state.robot.time > ({share} + 0.15) * state.schedule.duration")
        page.keyboard.up("ArrowLeft")
        peaks.append(state(page, "Math.max(...state.trace.map((row) => row[1]))"))
    assert peaks[1] > 1.3 * peaks[0]


def test_a_push_deviates_as_simulate_says_of_the_same_force(page, tmp_path):
    answers = []
    page.on("websocket", lambda socket: socket.on("framereceived", lambda text: answers.append(text)))
    page.reload()
    wait(page, "state.robot && state.robot.time > 0.2")
    page.keyboard.press("p")
    wait(page, "state.robot.time < 0.2")  # from rest at the start of a movement
    answers.clear()
    wait(page, "state.robot.time > 0.3 * state.schedule.duration")
    page.keyboard.down("ArrowUp")
    wait(page, "state.robot.time > 0.7 * state.schedule.duration")
    page.keyboard.up("ArrowUp")
    wait(page, "state.robot.time > 0.98 * state.schedule.duration")
    with page.expect_download() as download:
        page.click("text=schedule.npz")
    download.value.save_as(tmp_path / "schedule.npz")
    schedule = Schedule.load(tmp_path / "schedule.npz")
    states = [each for each in map(json.loads, answers) if each["type"] == "robot"]
    steps = np.diff([each["time"] for each in states])
    states = states[: 1 + np.argmin(steps) if steps.min() < 0.0 else None]  # until it begins again
    # The force of an answer was held over the ticks since the one before it.
    time, force = [each["time"] for each in states], np.array([each["force"] for each in states])
    held = force[np.searchsorted(time, schedule.time).clip(max=len(time) - 1)]
    simulated = np.linalg.norm(simulate(schedule, held).deviation, axis=1)
    assert max(each["deviation"] for each in states) == pytest.approx(simulated.max(), rel=0.02)


def test_keys_alone_draw_bend_and_push(page):
    page.click("#clear")
    page.focus("#scene")
    for key in ("ArrowRight", "ArrowLeft", "ArrowRight"):
        page.keyboard.press("Enter")
        page.keyboard.down(key)
        page.wait_for_timeout(900)
        page.keyboard.up(key)
        page.keyboard.press("Enter")
    wait(page, "state.strokes.length == 3")
    assert state(page, "state.strokes.every((stroke) => stroke.rows.length > 10)")
    page.keyboard.press("Control+z")
    wait(page, "state.strokes.length == 2")
    page.keyboard.press("e")
    wait(page, "state.shown.length && state.strokes.length == 6")
    page.keyboard.press("b")
    page.keyboard.press("]")
    page.keyboard.press("ArrowUp")
    wait(page, "state.via.length == 1")
    page.keyboard.press(" ")
    wait(page, "state.isPaused")


def test_a_stroke_of_a_finger_counts(browser, address):
    for page in opened(browser, address, has_touch=True):
        page.click("#clear")
        page.evaluate("""() => {
            const canvas = document.getElementById("scene"), box = canvas.getBoundingClientRect();
            canvas.setPointerCapture = () => {};
            const send = (type, i) => canvas.dispatchEvent(new PointerEvent(type, {
                pointerId: 7, pointerType: "touch", bubbles: true, clientX: box.x + 200 + 8 * i, clientY: box.y + 200,
            }));
            send("pointerdown", 0);
            let i = 0;
            const timer = setInterval(() => {
                i += 1;
                send(i < 30 ? "pointermove" : "pointerup", i);
                if (i == 30) clearInterval(timer);
            }, 16);
        }""")
        wait(page, "state.strokes.length == 1")


@pytest.mark.parametrize(("scale", "told"), [(1.0, "count as metres"), (1000.0, "not for its robot")])
def test_a_file_that_does_not_fit_is_scaled_and_that_is_told(page, scale, told, tmp_path):
    rows = [(k, 0.02 * i, 0.1 + 0.01 * i, 0.2 + 0.02 * k + 0.001 * i) for k in range(3) for i in range(40)]
    lines = [f"{k},{t},{scale * x},{scale * y}" for k, t, x, y in rows]
    (tmp_path / "own.csv").write_text("\n".join(["demo,time,x,y", *lines]) + "\n")
    page.set_input_files("#open", tmp_path / "own.csv")
    wait(page, "state.strokes.length == 3")
    shown = page.locator("#note").text_content()
    assert told in shown
    first = state(page, "state.strokes[0].rows[0].slice(1)")
    assert (first == pytest.approx([0.1, 0.2])) == (scale == 1.0)


def test_two_tabs_learn_each_their_own(browser, address):
    for first in opened(browser, address):
        for second in opened(browser, address):
            second.select_option("#example", "Letter S")
            wait(first, "state.shown.length")
            wait(second, "state.shown.length")
            paths = [state(each, "state.pictures[state.shown[0]].path") for each in (first, second)]
            assert paths[0] != paths[1]


@pytest.mark.parametrize("size", [(1280, 720), (1024, 768)])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_no_text_is_cut_or_lies_over_another(browser, address, size, scheme, tmp_path):
    for page in opened(browser, address, color_scheme=scheme):
        page.set_viewport_size({"width": size[0], "height": size[1]})
        wait(page, "state.schedule")
        page.screenshot(path=tmp_path / "page.png")
        overlaps = page.evaluate("""() => {
            const kinds = "h1, header p, button, h2, label, #told span, summary, output";
            const texts = [...document.querySelectorAll(kinds)].filter((each) =>
                each.offsetParent && each.textContent.trim() && !each.querySelector("button, input"));
            const box = (each) => each.getBoundingClientRect(), found = [];
            texts.forEach((a, i) => texts.slice(i + 1).forEach((b) => {
                if (a.contains(b) || b.contains(a)) return;
                const [p, q] = [box(a), box(b)];
                const across = Math.min(p.right, q.right) - Math.max(p.left, q.left);
                const down = Math.min(p.bottom, q.bottom) - Math.max(p.top, q.top);
                if (across > 1 && down > 1) found.push(`${a.textContent} / ${b.textContent}`);
            }));
            for (const each of texts)
                if (each.clientWidth && each.scrollWidth > each.clientWidth + 1) found.push(`cut: ${each.textContent}`);
            if (document.documentElement.scrollWidth > innerWidth) found.push("wider than the window");
            return found;
        }""")
        assert not overlaps
