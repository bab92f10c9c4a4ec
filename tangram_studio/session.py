"""The conversation with one page: its newest request replaces the one before."""

import asyncio
import logging
import secrets
from collections.abc import Awaitable, Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import msgspec

from tangram_core.errors import TangramError
from tangram_studio import filling, playing, saving
from tangram_studio.filling import Answer
from tangram_studio.jobs import Jobs
from tangram_studio.messages import Fill, Next, Play, Save, read, write
from tangram_studio.playing import Action, Move, Sides

ROUNDS = 5  # of a figure, at most, so that an agent without success ends, too
LAID = 0.95  # IoU from which a figure counts as laid
_KINDS = {"gif": "image/gif", "svg": "image/svg+xml", "json": "application/json"}
LOST = "an internal error: the terminal of tangram-studio shows it"

log = logging.getLogger(__name__)


@dataclass
class Game:
    """A figure that is being laid.

    Attributes:
        goal: the figure.
        motion: lift: tokens are carried; push: a finger pushes them.
        scene: the tokens as they lie.
        done: actions of this round.
        rounds: number of rounds before this one.
        moved: whether a token was moved in this round.
    """

    goal: Sides
    motion: str
    scene: Sides
    done: tuple[Action, ...] = ()
    rounds: int = 0
    moved: bool = False

    def goes_on(self, move: Move) -> bool:
        """Whether to go on after a move of no token, with the next action or the next round."""
        if not move.ended:
            self.done = move.done
            return True
        if move.iou >= LAID or not self.moved or self.rounds + 1 >= ROUNDS:
            return False
        self.done, self.rounds, self.moved = (), self.rounds + 1, False
        return True


class Session:
    """A connected page."""

    def __init__(
        self,
        tell: Callable[[str], Awaitable[None]],
        give: Callable[[bytes], Awaitable[None]],
        fills: Jobs,
        moves: Jobs,
    ) -> None:
        """Open the conversation.

        Args:
            tell: sends a message to the page.
            give: sends a file to the page.
            fills: pool for slow work.
            moves: pool for moves, which must not wait for slow work.
        """
        self._tell, self._give, self._fills, self._moves = tell, give, fills, moves
        self._game: Game | None = None
        self._goal: Sides | None = None
        self._played: list[Move] = []  # of this figure, also before an interruption
        self._sent = 0  # moves of this figure; a page may not have shown the last ones
        self._number = 0
        self._doing: asyncio.Task[None] | None = None
        self._saving: asyncio.Task[None] | None = None

    async def hear(self, text: str | bytes) -> None:
        """Handle a message: a request replaces the one before it, a save runs beside it."""
        try:
            asked = read(text)
        except TangramError as error:
            await self._tell(write("refused", number=None, why=str(error)))
            return
        if isinstance(asked, Save):  # beside what is being played
            if self._saving is not None and not self._saving.done():
                await self._tell(write("unsaved", why="another file is being made: wait for it"))
                return
            self._saving = asyncio.create_task(self._save(asked))
            return
        if isinstance(asked, Next) and self._doing is not None and not self._doing.done():
            return  # the move is being made already
        await _ended(self._doing)
        self._number = self._number if isinstance(asked, Next) else asked.number
        self._doing = asyncio.create_task(self._do(asked))

    async def end(self) -> None:
        """End all work for the page."""
        for task in (self._doing, self._saving):
            await _ended(task)

    async def _do(self, asked: Fill | Play | Next) -> None:
        try:
            await self._answer(asked)
        except TangramError as error:
            await self._say("refused", why=str(error))
        except Exception:  # a page must learn of every failure
            log.exception("a page's %s failed", type(asked).__name__.lower())
            await self._say("refused", why=LOST)

    async def _say(self, told: str, **content: Any) -> None:
        await self._tell(write(told, number=self._number, **content))

    async def _answer(self, asked: Fill | Play | Next) -> None:
        match asked:
            case Fill():
                self._game = None
                found = await self._fills.do(filling.fill, asked, waits=self._waits)
                await self._say("filled", **plain(found))
            case Play():
                await self._begin(asked)
            case Next():
                await self._next()

    async def _waits(self, ahead: int) -> None:
        await self._say("wait", ahead=ahead)

    async def _begin(self, asked: Play) -> None:
        goal = Sides(*asked.goal.sides)
        if asked.start is None:
            seed = secrets.randbelow(2**31)
            poses = await self._moves.do(playing.begin, goal, seed, waits=self._waits)
            scene, self._played, self._sent = Sides(poses, goal.flipped), [], 0
        else:
            scene = Sides(*asked.start.sides)
            self._played = self._seen(asked.shown)
            self._sent = min(self._sent, asked.shown)
        self._game, self._goal = Game(goal, asked.motion, scene), goal
        await self._next()

    async def _next(self) -> None:
        game = self._game
        if game is None:
            return
        move = await self._move(game)
        while move.token is None and game.goes_on(move):
            move = await self._move(game)
        game.done, game.scene = move.done, Sides(move.frames[-1], game.scene.flipped)
        over = move.token is None
        if over:
            self._game = None
        else:
            game.moved = True
            self._played = [*self._played, move][-saving.MOVES :]
            self._sent += 1
        await self._say(
            "move",
            token=move.token,
            frames=move.frames.round(5).tolist(),
            finger=None if move.finger is None else move.finger.round(5).tolist(),
            flipped=game.scene.flipped.tolist(),
            blocked=move.blocked,
            lifts=game.motion == "lift",
            coverage=move.coverage,
            iou=move.iou,
            over=over,
        )

    def _seen(self, shown: int) -> list[Move]:
        """The moves played, without those that the page has not begun to show."""
        unseen = max(self._sent - shown, 0)
        return self._played[: max(len(self._played) - unseen, 0)]

    async def _move(self, game: Game) -> Move:
        given = game.scene, game.goal, game.motion, game.done
        return await self._moves.do(playing.next_move, *given, waits=self._waits)

    async def _save(self, asked: Save) -> None:
        try:
            data = await self._fills.do(_saved, asked, self._seen(asked.shown), self._goal)
        except TangramError as error:
            await self._tell(write("unsaved", why=str(error)))
        except Exception:  # a page must learn of every failure
            log.exception("a page's save failed")
            await self._tell(write("unsaved", why=LOST))
        else:
            kind = asked.kind
            await self._tell(write("saved", kind=kind, type=_KINDS[kind], name=asked.name))
            await self._give(data)


async def _ended(task: "asyncio.Task[None] | None") -> None:
    if task is not None:
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task


def _saved(asked: Save, moves: list[Move], goal: Sides | None) -> bytes:
    tokens = Sides(*asked.tokens.sides)
    if asked.kind == "gif":
        return saving.gif(moves, tokens if goal is None else goal)
    return saving.svg(tokens) if asked.kind == "svg" else saving.puzzle_file(tokens, asked.name)


def plain(answer: Answer) -> dict[str, Any]:
    """An answer as plain data, for JSON."""
    goal = {"poses": answer.goal.poses.round(6).tolist(), "flipped": answer.goal.flipped.tolist()}
    solution = msgspec.to_builtins(answer.solution)
    return vars(answer) | {"goal": goal, "solution": solution}
