"""A page's conversation, with tasks that are done at once and in this process."""

import asyncio
import json
from collections.abc import Callable
from typing import Any, cast

import pytest

from tangram_studio import filling, playing, saving
from tangram_studio.jobs import Jobs
from tangram_studio.session import Session
from tests.studio.test_playing import figure

pytestmark = pytest.mark.slow


class Here:
    """Does tasks in this process, those that are held back only when they may go on."""

    def __init__(self) -> None:
        self.open = asyncio.Event()
        self.open.set()
        self.done: list[str] = []

    async def do(self, task: Callable[..., Any], *given: object, waits: Any = None) -> Any:
        if not self.open.is_set():
            if waits is not None:
                await waits(3)
            await self.open.wait()
        self.done.append(task.__name__)
        return task(*given)


class Page:
    """Asks, and keeps what it is told."""

    def __init__(self) -> None:
        self.told: list[dict[str, Any]] = []
        self.files: list[bytes] = []
        self.jobs = Here()
        jobs = cast(Jobs, self.jobs)
        self.session = Session(self._tell, self._give, jobs, jobs)

    async def _tell(self, text: str) -> None:
        self.told.append(json.loads(text))

    async def _give(self, data: bytes) -> None:
        self.files.append(data)

    async def ask(self, ask: str, **content: Any) -> dict[str, Any]:
        """Ask, and wait until it is done; the last thing that was told."""
        await self.session.hear(json.dumps({"ask": ask, **content}))
        begun = [one for one in (self.session._doing, self.session._saving) if one is not None]
        if begun:
            await asyncio.wait(begun)
        return self.told[-1]


def plain(name: str) -> dict[str, Any]:
    goal = figure(name)
    return {"poses": goal.poses.tolist(), "flipped": goal.flipped.tolist()}


def test_a_figure_is_filled_played_to_its_end_and_saved() -> None:
    async def talk() -> None:
        page = Page()
        found = await page.ask("fill", number=1, puzzle="cat")
        assert (found["told"], found["number"], found["exact"]) == ("filled", 1, True)
        assert found["iou"] > 0.999
        move = await page.ask("play", number=2, goal=found["goal"])
        tokens = list[int | None]()
        while not move["over"]:
            assert (move["told"], move["number"], move["lifts"]) == ("move", 2, True)
            tokens.append(move["token"])
            move = await page.ask("next")
        assert sorted(map(int, cast(list[int], tokens))) == list(range(7))
        assert (move["token"], move["iou"] > 0.99) == (None, True)
        count = len(page.told)
        await page.ask("next")  # nothing is being played any more
        assert len(page.told) == count
        last = {"poses": move["frames"][-1], "flipped": move["flipped"]}
        saved = await page.ask("save", kind="svg", tokens=last, name="cat")
        assert (saved["told"], saved["type"]) == ("saved", "image/svg+xml")
        assert page.files[0].startswith(b"<svg")

    asyncio.run(talk())


def test_it_goes_on_from_where_a_token_was_taken() -> None:
    async def talk() -> None:
        page, goal = Page(), plain("cat")
        start = {"poses": [*goal["poses"][:6], [0.9, -0.9, 1.0]], "flipped": goal["flipped"]}
        move = await page.ask("play", number=5, goal=goal, start=start)
        assert (move["token"], move["over"]) == (6, False)
        end = await page.ask("next")
        assert (end["over"], end["iou"] > 0.99) == (True, True)

    asyncio.run(talk())


@pytest.mark.parametrize(
    ("message", "why"),
    [
        ("{", "cannot read the page's message"),
        ('{"ask": "fill", "number": 1}', "exactly one of puzzle, outlines and pieces"),
        ('{"ask": "fill", "number": 1, "puzzle": "unicorn"}', "unknown puzzle 'unicorn'"),
        ('{"ask": "fill", "number": 1, "puzzle": "/etc/passwd"}', "unknown puzzle"),  # no file
    ],
)
def test_what_cannot_be_done_is_told(message: str, why: str) -> None:
    async def talk() -> None:
        page = Page()
        await page.session.hear(message)
        if page.session._doing is not None:
            await asyncio.wait([page.session._doing])
        (told,) = page.told
        assert told["told"] == "refused"
        assert told["number"] == (None if message == "{" else 1)
        assert why in told["why"]

    asyncio.run(talk())


def test_a_failure_of_the_code_is_told_and_logged(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def broken(*_: object) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(filling, "fill", broken)

    async def talk() -> None:
        told = await Page().ask("fill", number=1, puzzle="cat")
        assert "terminal" in told["why"]

    asyncio.run(talk())
    assert "a page's fill failed" in caplog.text


def test_the_newest_question_takes_the_place_of_the_one_before() -> None:
    async def talk() -> None:
        page = Page()
        page.jobs.open.clear()
        await page.session.hear('{"ask": "fill", "number": 1, "puzzle": "cat"}')
        await asyncio.sleep(0)
        await page.session.hear('{"ask": "fill", "number": 2, "puzzle": "swan"}')
        await asyncio.sleep(0)
        page.jobs.open.set()
        assert page.session._doing is not None
        await asyncio.wait([page.session._doing])
        assert [(one["told"], one["number"]) for one in page.told] == [
            ("wait", 1),
            ("wait", 2),
            ("filled", 2),
        ]
        assert page.told[0]["ahead"] == 3

    asyncio.run(talk())


def test_a_file_is_made_beside_what_is_played(monkeypatch: pytest.MonkeyPatch) -> None:
    async def talk() -> None:
        page, goal = Page(), plain("cat")
        move = await page.ask("play", number=1, goal=goal)
        last = {"poses": move["frames"][-1], "flipped": move["flipped"]}
        page.jobs.open.clear()
        await page.session.hear('{"ask": "next"}')
        gif = {"ask": "save", "kind": "gif", "tokens": last, "shown": 1}
        await page.session.hear(json.dumps(gif))
        await page.session.hear(json.dumps({"ask": "save", "kind": "svg", "tokens": last}))
        assert page.told[-1]["told"] == "unsaved"  # one file at a time
        page.jobs.open.set()
        assert page.session._doing is not None
        assert page.session._saving is not None
        await asyncio.wait([page.session._doing, page.session._saving])
        kinds = sorted(one["told"] for one in page.told if one["told"] != "wait")
        assert kinds == ["move", "move", "saved", "unsaved"]
        assert page.files[0].startswith(b"GIF89a")

    asyncio.run(talk())


def test_what_cannot_be_saved_is_told_and_ends_nothing() -> None:
    async def talk() -> None:
        page, goal = Page(), plain("cat")
        await page.ask("play", number=1, goal=goal)
        heap = {"poses": [[0.0, 0.0, 0.0]] * 7, "flipped": [False] * 7}
        told = await page.ask("save", kind="json", tokens=heap)
        assert (told["told"], "this is no puzzle" in told["why"]) == ("unsaved", True)
        assert (await page.ask("next"))["told"] == "move"

    asyncio.run(talk())


# A letter is a call of the agent: m moves a token, n is an action that moves none, e finds all
# actions of the round used up.
@pytest.mark.parametrize(
    ("calls", "asks", "rounds"),
    [
        ("nnm", 1, 1),  # the round goes on
        ("e", 1, 1),  # nothing was moved in it: it ends
        ("nne", 1, 1),
        ("mem", 2, 2),
        ("mememememe", 6, 5),  # five rounds
        ("mene", 2, 2),
    ],
)
def test_a_round_goes_on_until_its_actions_are_used_up(
    monkeypatch: pytest.MonkeyPatch, calls: str, asks: int, rounds: int
) -> None:
    left, given = list(calls), list[object]()

    def move(
        scene: playing.Sides, goal: object, motion: str, done: tuple[int, ...]
    ) -> playing.Move:
        given.append(done)
        kind = left.pop(0)
        token = 3 if kind == "m" else None
        used = (*done, 3)
        return playing.Move(token, scene.poses[None], False, 0.1, 0.1, used, kind == "e")

    monkeypatch.setattr(playing, "next_move", move)

    async def talk() -> None:
        page, goal = Page(), plain("cat")
        told = await page.ask("play", number=1, goal=goal, start=goal)
        for _ in range(asks - 1):
            assert told["over"] is False
            told = await page.ask("next")
        assert told["over"] is (calls[-1] == "e")

    asyncio.run(talk())
    assert left == []
    assert given.count(()) == rounds  # begins with nothing done


def test_a_file_has_no_move_that_was_not_shown() -> None:
    async def talk() -> None:
        page, goal = Page(), plain("cat")
        move = await page.ask("play", number=1, goal=goal)
        for _ in range(3):
            move = await page.ask("next")
        scene = {"poses": move["frames"][-1], "flipped": move["flipped"]}
        first, second, *_ = page.session._played
        assert len(page.session._played) == 4
        await page.ask("save", kind="gif", tokens=scene, shown=2)  # while two more lie ready
        assert page.files == [saving.gif([first, second], figure("cat"))]
        told = await page.ask("save", kind="gif", tokens=scene, shown=0)
        assert "nothing was played yet" in told["why"]
        await page.ask("play", number=2, goal=goal, start=scene, shown=2)
        assert len(page.session._played) == 3  # two that were shown, and the new one
        await page.ask("play", number=3, goal=goal, start=scene, shown=3)
        assert len(page.session._played) == 4
        await page.ask("play", number=4, goal=goal)
        assert len(page.session._played) == 1  # another game

    asyncio.run(talk())
