"""The studio's page in a real browser, Debian's Chromium: every way that a person may take.

studio/try.sh installs the browser, runs this with all that it has, and keeps the pictures.
"""

import json
import math
import os
import re
import shutil
import time
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import msgspec
import pytest
from PIL import Image, ImageDraw
from playwright.sync_api import Browser, Page, expect, sync_playwright

from tangram_sim.puzzles.assembly import PuzzleRules
from tangram_sim.puzzles.figures import read_puzzles
from tangram_vision.solution import Solution
from tests.cluster.studios import Running, studio
from tests.conftest import NO_BROWSER

CHROMIUM = shutil.which("chromium")
TRIED = "TANGRAM_TRY_STUDIO" in os.environ
ROOT = Path(__file__).parents[2]
SILHOUETTE = ROOT / "docs/images/silhouette.png"
LONG_MS = 90_000.0  # a busy machine shows moves slowly
BROWSERS = 20

pytestmark = [
    pytest.mark.cluster,
    pytest.mark.xdist_group("studio"),
    pytest.mark.timeout(300),
    pytest.mark.skipif(
        CHROMIUM is None and not TRIED, reason=f"{NO_BROWSER}: studio/try.sh installs it"
    ),
]

LAID = re.compile(r"^Solved!$|^Laid: the nearest figure")


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        # As root Chromium has no sandbox, and it asks nobody for anything.
        quiet = ["--no-sandbox", "--disable-background-networking", "--disable-component-update"]
        found = playwright.chromium.launch(executable_path=CHROMIUM, args=quiet)
        yield found
        found.close()


@pytest.fixture
def page(browser: Browser, running: Running) -> Iterator[Page]:
    """The page, open; nothing that it does may fail unseen."""
    context = browser.new_context(viewport={"width": 1200, "height": 860})
    with_errors = list[str]()
    found = opened(context.new_page(), running)
    found.on("pageerror", lambda error: with_errors.append(str(error)))
    yield found
    context.close()
    assert with_errors == []


def opened(page: Page, running: Running, quick: bool = True) -> Page:
    """The page; unless its pace is what is looked at, a move takes a fifth of its second."""
    page.set_default_timeout(LONG_MS)
    expect.set_options(timeout=LONG_MS)
    page.goto(running.url)
    page.locator("[data-figure=cat]").wait_for()
    if quick:
        page.evaluate("studio.board.ms = 200")
    return page


def shot(page: Page, name: str) -> None:
    """Keep a picture where studio/try.sh wants them."""
    folder = os.environ.get("TANGRAM_STUDIO_PICTURES")
    if folder:
        page.screenshot(path=Path(folder) / f"studio_{name}.png")


def source(page: Page, kind: str) -> None:
    page.locator(f"[name=source][value={kind}]").check()


def status(page: Page) -> Any:
    return expect(page.locator("#status"))


def on_table(page: Page, x: float, y: float) -> tuple[float, float]:
    """Pixels of a point of the arena."""
    found = page.evaluate(
        """([x, y]) => {
            const p = new DOMPoint(x, y).matrixTransform(studio.board.table.getScreenCTM());
            return [p.x, p.y];
        }""",
        [x, y],
    )
    return found[0], found[1]


def drag(page: Page, way: list[tuple[float, float]], lets_go: bool = True) -> None:
    """Press at the first point of the arena, go along the others, let go."""
    first, *rest = [on_table(page, *point) for point in way]
    page.mouse.move(*first)
    page.mouse.down()
    for point in rest:
        page.mouse.move(*point, steps=3)
    if lets_go:
        page.mouse.up()


def moving(page: Page, token: int | None = None) -> None:
    """Wait until the agent moves a token."""
    end = time.monotonic() + LONG_MS / 1000
    while time.monotonic() < end:
        found = page.evaluate("studio.board.move ? studio.board.move.token : null")
        if found is not None and token in (None, found):
            return
    pytest.fail(f"nothing moves: {page.locator('#status').inner_text()}")


def after(page: Page, moves: int) -> None:
    """Wait until so many moves are over, or all are."""
    end = time.monotonic() + LONG_MS / 1000
    while page.evaluate("studio.board.frames.moves") < moves and time.monotonic() < end:
        page.wait_for_timeout(20)
    page.wait_for_timeout(100)  # in mid-move


# A figure, and files


def test_a_figure_is_seen_laid_and_saved(page: Page, tmp_path: Path) -> None:
    page.locator("[data-figure=cat]").click()
    moving(page)
    after(page, 4)
    shot(page, "play")
    status(page).to_have_text(LAID)
    expect(page.locator("#told")).to_contain_text("filled by the search")
    expect(page.locator("#seen-pieces polygon")).to_have_count(7)
    frames = page.evaluate("studio.board.frames")
    assert frames["moves"] == 7
    for kind, begins in {"gif": b"GIF89a", "svg": b"<svg", "json": b"{"}.items():
        with page.expect_download() as saved:
            page.locator(f"#save-{kind}").click()
        assert saved.value.suggested_filename == f"cat.{kind}"
        path = tmp_path / f"cat.{kind}"
        saved.value.save_as(path)
        assert path.read_bytes().startswith(begins)
    (puzzle,) = read_puzzles(tmp_path / "cat.json", PuzzleRules(0.6))
    assert puzzle.name == "cat"
    with Image.open(tmp_path / "cat.gif") as film:
        assert getattr(film, "n_frames", 1) > 60


@pytest.mark.check
def test_what_was_taken_away_while_it_plays_is_laid_again(page: Page) -> None:
    page.locator("[data-figure=swan]").click()
    moving(page)
    after(page, 2)
    page.evaluate("studio.board.ms = 20_000")  # until the hand is there nothing comes over it
    page.wait_for_timeout(100)
    token = page.evaluate(
        """() => {  // one that lies in its place
            const goal = studio.goal.poses.map(([x, y]) => [x, y]);
            const far = studio.board.poses.map(([x, y], k) => k === studio.board.move?.token ? 9 :
                Math.min(...goal.map(([u, v]) => Math.hypot(x - u, y - v))));
            return far.indexOf(Math.min(...far));
        }"""
    )
    x, y, _ = page.evaluate(f"studio.board.poses[{token}]")
    drag(page, [(x, y), (0.0, 0.85), (-0.85, 0.85)], lets_go=False)
    assert page.evaluate(f"studio.board.poses[{token}]")[0] < -0.7
    status(page).to_contain_text("the agent goes on from here")
    page.evaluate("studio.board.ms = 200")
    page.mouse.up()  # the agent may bring it back at once
    ring = f"getComputedStyle(studio.board.tans[{token}]).outlineStyle"
    assert page.evaluate(ring) == "none"  # of 5 px it would cover the table
    moving(page, token)  # that very one
    shot(page, "taken")
    status(page).to_have_text(LAID)


@pytest.mark.check
def test_tans_are_pushed_too(page: Page) -> None:
    page.locator("#motion").select_option("push")
    page.locator("[data-figure=cat]").click()
    moving(page)
    assert page.evaluate("studio.board.move.frames.length") == 21
    expect(page.locator(".finger")).to_be_visible()
    after(page, 6)
    shot(page, "pushed")
    status(page).to_have_text(re.compile("^(Solved!|The agent can do no more.)$"))


# Laying out


@pytest.mark.check
def test_a_figure_is_laid_out_of_tans_that_snap_and_lie_beside_each_other(page: Page) -> None:
    source(page, "lay")
    (x, y, _), (u, v, _) = (page.evaluate(f"studio.board.poses[{k}]") for k in (0, 1))
    drag(page, [(x, y), (u, v)])
    page.locator("#lay-done").click()
    status(page).to_contain_text(
        "That did not work: the tans lie in 6 groups: move them until they touch"
    )
    expect(page.locator("#status")).to_have_class("bad")
    x, y, _ = page.evaluate("studio.board.poses[0]")
    (a, b), (c, d), _ = page.evaluate("studio.board.tokens[0].corners")
    near = u + a - c + 0.02, v + b - d + 0.01  # so that a corner all but meets a corner
    drag(page, [(x, y), (u - 0.4, v), near])
    gaps = page.evaluate(
        """() => {  // between corners of the one and corners of the other
            const [one, other] = [studio.board.corners(0), studio.board.corners(1)];
            return one.flatMap(([x, y]) => other.map(([u, v]) => Math.hypot(x - u, y - v)));
        }"""
    )
    assert min(gaps) < 1e-9
    before = page.evaluate("studio.board.poses[0][2]")
    page.locator("#turn-left").click()
    assert page.evaluate("studio.board.poses[0][2]") == pytest.approx(before + math.pi / 4)
    page.locator("#turn-right").click()
    assert page.evaluate("studio.board.poses[0][2]") == pytest.approx(before)


@pytest.mark.check
def test_a_tan_is_moved_turned_and_turned_over_by_keys(page: Page) -> None:
    source(page, "lay")
    tan = page.get_by_role("button", name="parallelogram")
    tan.focus()
    x, y, angle = page.evaluate("studio.board.poses[6]")
    for key in ("ArrowUp", "ArrowUp", "ArrowRight", "r", "f"):
        page.keyboard.press(key)
    u, v, turned = page.evaluate("studio.board.poses[6]")
    assert (u - x, v - y) == (pytest.approx(0.05, abs=0.03), pytest.approx(0.1, abs=0.05))
    assert turned == pytest.approx(angle + math.pi / 4)
    assert page.evaluate("studio.board.flipped[6]")
    expect(tan).to_be_focused()


# Drawing


def test_a_square_is_drawn_corner_by_corner_with_snapping(page: Page) -> None:
    """After corners that are taken back."""
    source(page, "draw")
    for x, y in ((0.0, 0.0), (0.3, 0.0), (0.3, 0.3)):
        page.mouse.click(*on_table(page, x, y))
    page.locator("#draw-undo").click()
    assert page.evaluate("studio.pen.line.length") == 2
    page.locator("#draw-clear").click()
    assert page.evaluate("studio.pen.line.length") == 0
    page.locator("#draw-done").click()
    status(page).to_contain_text("Nothing is drawn yet")
    for x, y in ((-0.3, -0.3), (0.29, -0.32), (0.31, 0.28), (-0.29, 0.31)):
        page.mouse.click(*on_table(page, x, y))
    expect(page.locator("#area")).to_contain_text("Area: 1.00 of the seven tans")
    page.mouse.click(*on_table(page, -0.31, -0.29))
    expect(page.locator("#told")).to_contain_text("filled by the search")
    status(page).to_have_text(LAID)


@pytest.mark.check
def test_a_figure_is_drawn_by_keys_alone(page: Page) -> None:
    source(page, "draw")
    page.locator("#board").focus()
    ways = {"ArrowLeft": 6, "ArrowDown": 6}, {"ArrowRight": 12}, {"ArrowUp": 12}, {"ArrowLeft": 12}
    for way in ways:
        for key, times in way.items():
            for _ in range(times):
                page.keyboard.press(key)
        page.keyboard.press("Space")
    page.keyboard.press("Enter")
    expect(page.locator("#told")).to_contain_text("filled by the search")
    moving(page)


CAT = [  # a head with two ears, a body, a tail
    *[(-0.45, 0.55), (-0.3, 0.35), (-0.1, 0.35), (0.05, 0.55), (0.06, 0.1), (0.25, -0.1)],
    *[(0.3, -0.5), (0.75, -0.5), (0.78, -0.3), (0.6, -0.35), (0.4, -0.62), (-0.45, -0.62)],
    *[(-0.4, -0.1), (-0.5, 0.1)],
]


@pytest.mark.check
def test_a_cat_by_a_free_hand_becomes_the_nearest_figure(page: Page) -> None:
    source(page, "draw")
    page.locator("[name=pen][value=free]").check()
    drag(page, [*CAT, CAT[0]])
    expect(page.locator("#told")).to_contain_text("Seven tans do not fill it; this is the nearest")
    moving(page)
    after(page, 3)
    shot(page, "cat")
    status(page).to_have_text("Laid: the nearest figure of seven tans.")


@pytest.mark.check
def test_a_free_hand_draws_again_where_the_last_was_refused_or_laid(page: Page) -> None:
    source(page, "draw")
    page.locator("[name=pen][value=free]").check()
    drag(page, [(-0.9, 0.8 + 0.001 * i) for i in range(2)] + [(0.9, 0.8), (0.0, 0.81), (-0.9, 0.8)])
    status(page).to_contain_text("That did not work")
    for width in (0.4, 0.6):
        square = [(-width, -width), (width, -width), (width, width), (-width, width)]
        drag(page, [*square, square[0]])
        assert page.evaluate("studio.last.outlines.length") == 1
        moving(page)
        status(page).to_have_text(LAID)


STRIP = [(-0.95, 0.0), (0.95, 0.0), (0.95, 0.07), (-0.95, 0.07)]


@pytest.mark.check
@pytest.mark.parametrize(
    ("points", "why"),
    [
        ([(-0.5, 0.0), (0.0, 0.0), (0.5, 0.0)], "draws nothing that has an area"),
        (STRIP, "from its middle"),
        ([*STRIP, STRIP[0]], "from its middle"),  # closed by its last corner
    ],
)
def test_an_impossible_drawing_is_told_why_and_the_next_corner_begins_another(
    page: Page, points: list[tuple[float, float]], why: str
) -> None:
    source(page, "draw")
    page.locator("#snap").uncheck()
    for x, y in points:
        page.mouse.click(*on_table(page, x, y))
    if points[-1] != points[0]:
        page.locator("#draw-done").click()
    status(page).to_contain_text(why)
    shot(page, "impossible")
    for x, y in [(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5), (-0.5, -0.5)]:
        page.mouse.click(*on_table(page, x, y))
    (outline,) = page.evaluate("studio.last.outlines")
    assert len(outline) == 4
    status(page).to_have_text(LAID)


# Pictures


@pytest.mark.check
def test_a_picture_is_dropped_on_the_table(page: Page) -> None:
    data = list(SILHOUETTE.read_bytes())
    page.evaluate(
        """(data) => {
            const moved = new DataTransfer();
            moved.items.add(new File([new Uint8Array(data)], "a bird.png", {type: "image/png"}));
            const event = (kind) => new DragEvent(kind, {dataTransfer: moved, bubbles: true});
            document.body.dispatchEvent(event("dragover"));
            document.body.dispatchEvent(event("drop"));
        }""",
        data,
    )
    expect(page.locator("#told")).to_contain_text("filled by")
    status(page).to_have_text(LAID)
    assert page.evaluate("studio.name") == "a_bird"


@pytest.mark.check
def test_wrong_files_have_their_words(page: Page, tmp_path: Path) -> None:
    source(page, "file")
    wrong = {
        "notes.txt": (b"x", "a file of the kind '.txt' cannot be read"),
        "broken.png": (b"\x89PNG\r\n", "no PNG that can be read"),
        "large.png": (b"0" * 10_000_001, "large.png is larger than 10 MB"),
        "evil.svg": (b"<svg><script>alert(1)</script></svg>", "draws nothing"),
        "empty.json": (b"{}", "must be a mapping"),
    }
    for name, (data, why) in wrong.items():
        (tmp_path / name).write_bytes(data)
        page.locator("#file").set_input_files(tmp_path / name)
        status(page).to_contain_text(why)
    shot(page, "wrong")
    photo = Image.new("RGB", (300, 300), "white")
    photo.save(tmp_path / "blank.png")
    page.locator("#file").set_input_files(tmp_path / "blank.png")
    status(page).to_contain_text("shows nothing")


@pytest.mark.check
def test_a_drawing_in_which_tans_leave_room_is_still_told(page: Page, tmp_path: Path) -> None:
    picture = Image.new("L", (300, 300), 255)
    ImageDraw.Draw(picture).ellipse((60, 60, 240, 240), 0)
    picture.save(tmp_path / "disc.png")
    source(page, "file")
    page.locator("#file").set_input_files(tmp_path / "disc.png")
    expect(page.locator("#told")).to_contain_text(
        "Seven tans do not fill it; this is the nearest figure"
    )
    moving(page)


# The connection


@pytest.mark.check
def test_a_page_tells_how_many_there_are(page: Page, browser: Browser, running: Running) -> None:
    context = browser.new_context()
    other = opened(context.new_page(), running)
    for one in (page, other):
        expect(one.locator("#pages")).to_have_text("2 pages are open, each with a table of its own")
    context.close()
    expect(page.locator("#pages")).to_have_text("")


@pytest.mark.check
def test_a_file_is_saved_while_it_plays_on(page: Page, tmp_path: Path) -> None:
    page.locator("[data-figure=cat]").click()
    moving(page)
    with page.expect_download():
        page.locator("#save-gif").click()
    with page.expect_download() as saved:  # the figure, not the tans in mid-move
        page.locator("#save-json").click()
    saved.value.save_as(tmp_path / "cat.json")
    (puzzle,) = read_puzzles(tmp_path / "cat.json", PuzzleRules(0.6))
    assert puzzle.name == "cat"
    after(page, 7)


@pytest.mark.check
def test_a_tan_that_is_touched_while_it_looks_loses_no_figure(page: Page) -> None:
    page.evaluate(
        "studio.send = ((send) => (m) => setTimeout(() => send(m), 1500))(studio.send.bind(studio))"
    )
    page.locator("[data-figure=cat]").click()
    page.get_by_role("button", name="medium triangle").focus()
    page.keyboard.press("ArrowUp")
    status(page).to_have_text(LAID)
    assert page.evaluate("studio.name") == "cat"


@pytest.mark.check
def test_keys_of_before_do_not_bring_an_old_figure_back(page: Page) -> None:
    page.locator("[data-figure=swan]").click()
    moving(page)
    page.get_by_role("button", name="medium triangle").focus()
    page.keyboard.press("ArrowUp")
    page.locator("[data-figure=cat]").click()
    status(page).to_have_text(LAID)
    (cat,) = [
        one
        for one in page.evaluate("fetch('api/figures').then((a) => a.json())")["figures"]
        if one["name"] == "cat"
    ]
    ys = [y for ring in cat["outline"] for _, y in ring]
    laid = [y for k in range(7) for _, y in page.evaluate(f"studio.board.corners({k})")]
    assert max(laid) == pytest.approx(max(ys), abs=0.05)


def test_it_goes_on_after_a_short_loss(page: Page) -> None:
    """Of the first move little is shown, on any clock: a tan left halfway may be in the way."""
    page.evaluate(
        """() => {
            const board = studio.board, closed = studio.closed.bind(studio);
            const between = board.between.bind(board);
            board.ms = Infinity;
            board.between = (move) => between(move, 0.1);
            studio.closed = (code) => {
                studio.before = board.frames.moves;
                const done = closed(code);
                delete board.between;
                board.ms = 200;
                return done;
            };
        }"""
    )
    page.locator("[data-figure=cat]").click()
    moving(page)
    # The picture after the next one has the move in it.
    page.evaluate("new Promise((go) => requestAnimationFrame(() => requestAnimationFrame(go)))")
    page.evaluate("studio.socket.close()")
    expect(page.locator("#banner")).to_contain_text("Lost the connection")
    status(page).to_have_text(LAID)
    expect(page.locator("#banner")).to_be_hidden()
    # The server, too, counts anew what it sent.
    assert page.evaluate("studio.begun === studio.board.frames.moves - studio.before")


@pytest.mark.check
def test_a_lost_connection_and_a_new_studio_are_told(browser: Browser, tmp_path: Path) -> None:
    context = browser.new_context()
    page = context.new_page()
    with studio(tmp_path) as first:
        opened(page, first)
        page.locator("[data-figure=cat]").click()
        moving(page)
        first.process.kill()
        expect(page.locator("#banner")).to_contain_text("Lost the connection to tangram-studio")
        shot(page, "lost")
    with studio(tmp_path, f"port={first.port}") as second:
        expect(page.locator("#banner")).to_contain_text("tangram-studio was restarted")
        opened(page, second)
        expect(page.locator("#banner")).to_be_hidden()
    context.close()


# Everybody


@pytest.mark.check
def test_what_is_laid_goes_on_while_another_way_is_looked_at(page: Page) -> None:
    page.locator("[data-figure=cat]").click()
    moving(page)
    source(page, "file")
    source(page, "library")
    page.locator("#motion").select_option("push")  # at once, from where they lie
    moving(page)
    page.locator("#motion").select_option("lift")
    status(page).to_have_text(LAID)


@pytest.mark.check
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_it_fits_a_phone_in_light_and_dark(browser: Browser, running: Running, scheme: Any) -> None:
    context = browser.new_context(
        viewport={"width": 360, "height": 740}, color_scheme=scheme, has_touch=True
    )
    page = opened(context.new_page(), running)
    for kind in ("library", "lay", "draw", "file"):
        source(page, kind)
        assert page.evaluate("document.documentElement.scrollWidth") <= 360
    source(page, "library")
    page.locator("[data-figure=cat]").tap()
    status(page).to_have_text(LAID)
    page.evaluate("scrollTo(0, 0)")
    shot(page, f"phone_{scheme}")
    paper = page.evaluate("getComputedStyle(document.body).backgroundColor")
    levels = [int(level) for level in re.findall(r"\d+", paper)]
    assert (sum(levels) > 600) == (scheme == "light")
    context.close()


@pytest.mark.check
def test_who_wants_no_motion_sees_where_tans_come_to_lie(
    browser: Browser, running: Running
) -> None:
    context = browser.new_context(reduced_motion="reduce")
    page = opened(context.new_page(), running)
    page.locator("[data-figure=cat]").click()
    status(page).to_have_text(LAID)
    frames = page.evaluate("studio.board.frames")
    assert frames["shown"] <= frames["moves"] + 1
    context.close()


# In motion


@pytest.mark.check
@pytest.mark.skipif("TANGRAM_STUDIO_PICTURES" not in os.environ, reason="it makes a picture")
def test_the_page_in_motion_is_filmed(browser: Browser, running: Running) -> None:
    """A cat that is drawn, laid, taken apart and mended: studio.gif, which README shows."""
    context = browser.new_context(viewport={"width": 1000, "height": 720})
    page, frames = opened(context.new_page(), running, quick=False), list[Image.Image]()

    def keep() -> None:
        with Image.open(BytesIO(page.screenshot())) as whole:
            frames.append(whole.convert("RGB").resize((800, 576), Image.Resampling.LANCZOS))

    source(page, "draw")
    page.locator("[name=pen][value=free]").check()
    page.mouse.move(*on_table(page, *CAT[0]))
    page.mouse.down()
    for point in [*CAT, CAT[0]]:
        page.mouse.move(*on_table(page, *point), steps=3)
        keep()
    page.mouse.up()
    while not (page.locator("#status").text_content() or "").startswith(("Laid", "Solved")):
        page.wait_for_timeout(100)
        keep()
        assert len(frames) < 110
    x, y, _ = page.evaluate("studio.board.poses[0]")
    drag(page, [(x, y), (0.6, 0.3), (0.75, 0.75)])
    for _ in range(14):
        page.wait_for_timeout(100)
        keep()
    status(page).to_have_text("Laid: the nearest figure of seven tans.")
    keep()
    context.close()
    colours = frames[-1].quantize(128)  # all tans are in it
    film = [
        frame.quantize(palette=colours, dither=Image.Dither.NONE)
        for frame in [*frames, *frames[-1:] * 8]
    ]
    path = Path(os.environ["TANGRAM_STUDIO_PICTURES"]) / "studio.gif"
    film[0].save(path, save_all=True, append_images=film[1:], duration=130, loop=0, optimize=True)
    assert path.stat().st_size < 4_000_000


# Many


@pytest.mark.check
@pytest.mark.skipif(not TRIED, reason="20 browsers take two cores for a minute: studio/try.sh")
def test_twenty_browsers_at_once_lay_their_figures(browser: Browser, running: Running) -> None:
    pages = [
        opened(browser.new_context().new_page(), running, quick=False) for _ in range(BROWSERS)
    ]
    for number, one in enumerate(pages):
        one.evaluate(f"document.querySelectorAll('[data-figure]')[{number}].click()")
    rates, waited = list[float](), list[float]()
    for one in pages:
        status(one).to_have_text(LAID)
        frames = one.evaluate("studio.board.frames")
        rates.append(frames["shown"] / frames["moves"])  # a move takes a second
        waited.append(frames["waited"])
    told = {"frames_a_second": sorted(map(round, rates)), "waited_ms": sorted(map(round, waited))}
    print(json.dumps(told))
    for one in pages:
        one.context.close()


def test_a_person_lays_a_figure_and_is_told_that_it_is_solved(page: Page) -> None:
    """Hints lay all but one tan; that one is dragged, and snaps."""
    source(page, "solve")
    page.locator("[data-figure=cat]").click()
    status(page).to_have_text(re.compile("^Drag the tans onto the figure"))
    expect(page.locator("#answer")).to_be_hidden()  # it would tell
    shot(page, "solve")
    for _ in range(6):
        page.locator("#hint").click()
    status(page).to_have_text(re.compile("^The .* is laid"))
    k, x, y, angle, flipped = page.evaluate(
        """() => {
            const { poses, flipped } = studio.solving.answer.goal, own = studio.board.poses;
            const far = ([x, y], i) => Math.hypot(x - own[i][0], y - own[i][1]) > 0.03;
            const k = poses.findIndex(far);
            return [k, ...poses[k], flipped[k]];
        }"""
    )
    page.evaluate(
        """([k, angle, flipped]) => {
            studio.board.poses[k][2] = angle - Math.PI / 4;
            studio.board.flipped[k] = flipped;
            studio.board.draw();
        }""",
        [k, angle, flipped],
    )
    here = page.evaluate("k => studio.board.poses[k].slice(0, 2)", k)
    drag(page, [tuple(here), (x, y)])
    page.evaluate("([k, x, y]) => { studio.board.move_to(k, x, y); }", [k, x, y])
    expect(page.locator("#numbers")).to_be_hidden()
    page.locator("#turn-left").click()
    status(page).to_have_text(re.compile(r"^Solved! It took you \d:\d\d\.$"))
    expect(page.locator("#numbers")).to_contain_text("Details")
    shot(page, "solved")
    page.locator("#lay-clear").click()
    status(page).to_have_text(re.compile("^Drag the tans"))


def test_the_agent_races(page: Page) -> None:
    source(page, "solve")
    page.locator("[data-figure=cat]").click()
    status(page).to_have_text(re.compile("^Drag the tans onto the figure"))
    page.locator("#race").click()
    pieces = page.locator("#seen-pieces polygon:visible")
    expect(pieces).to_have_count(0)
    expect(pieces).to_have_count(7)
    status(page).to_have_text(re.compile(r"^The agent was first, in 0:\d\d\."))
    page.evaluate(
        "studio.solving.race(); studio.solving.raced({ token: null, over: true, iou: 0.4 })"
    )
    status(page).to_have_text(re.compile(r"^The agent can do no more\."))
    assert page.evaluate("studio.board.poses[0][1]") == pytest.approx(0.7)  # the person's own lie


def test_an_answer_is_saved_as_data(page: Page, tmp_path: Path) -> None:
    page.locator("[data-figure=cat]").click()
    page.locator("#answer").wait_for()
    with page.expect_download() as caught:
        page.locator("#save-solution").click()
    caught.value.save_as(tmp_path / "it.json")
    found = msgspec.json.decode((tmp_path / "it.json").read_bytes(), type=Solution)
    assert (found.kind, len(found.tokens), found.source) == ("filled", 7, "puzzle")


def test_tans_that_lie_apart_are_no_figure(page: Page) -> None:
    source(page, "lay")
    page.locator("#lay-done").click()
    status(page).to_have_text(re.compile("the tans lie in 7 groups: move them until they touch"))
