"""Files of what was played: a GIF of the moves, an SVG of the tokens, or a puzzle file.

Legend: K tokens, F frames, V corners.
"""

import json
from collections.abc import Sequence
from io import BytesIO

import numpy as np

from tangram_core.arrays import Floats
from tangram_core.errors import ConfigError
from tangram_sim.drawing.game_drawing import Held, draw_game
from tangram_sim.drawing.scenes import save_gif
from tangram_sim.drawing.strokes import colour_of
from tangram_sim.geometry.layout import Layout
from tangram_sim.motion.kinematics import wrap
from tangram_sim.puzzles.figures import parse_puzzles
from tangram_sim.puzzles.sketches import FORMAT, VERSION
from tangram_studio.playing import Move, Sides, player

FRAMES = 10  # of a move: at 20 frames a second a GIF is twice as fast as the page
FRAME_MS = 50
MOVES = 60  # moves in a GIF, the last ones
_PIXELS, _STILL = 360, 20
_DIGITS = 6
_SVG = 500  # pixels


def gif(moves: Sequence[Move], goal: Sides) -> bytes:
    """An animated GIF of the moves.

    Raises:
        ConfigError: nothing was played.
    """
    if not moves:
        raise ConfigError("nothing was played yet: let the agent lay a figure first")
    own = player()
    layout, arena = own.layout, own.run.task.sim.arena
    target = layout.corners(*goal)
    pictures = [
        draw_game(layout, arena, layout.corners(poses, goal.flipped), target, _PIXELS, held)
        for move in moves[-MOVES:]
        for poses, held in _shown(move)
    ]
    end = draw_game(
        layout, arena, layout.corners(moves[-1].frames[-1], goal.flipped), target, _PIXELS
    )
    data = BytesIO()
    save_gif([pictures[0]] * (_STILL // 2) + pictures + [end] * _STILL, data, FRAME_MS)
    return data.getvalue()


def _shown(move: Move) -> list[tuple[Floats, Held | None]]:
    """Poses (K, 3) at equal times of a move, and what is held then."""
    frames, shown = move.frames, list[tuple[Floats, Held | None]]()
    for share in np.arange(1, FRAMES + 1) / FRAMES:
        at = share * (len(frames) - 1)
        first = min(int(at), len(frames) - 2) if len(frames) > 1 else 0
        way = frames[min(first + 1, len(frames) - 1)] - frames[first]
        way[:, 2] = wrap(way[:, 2])
        height = float(np.sin(np.pi * share)) if len(frames) == 2 else 0.0
        finger = None if move.finger is None else move.finger[round(at)]
        held = None if move.token is None else Held(move.token, height, move.blocked, finger)
        shown.append((frames[first] + (at - first) * way, held))
    return shown


def svg(tokens: Sides) -> bytes:
    """An SVG of the tokens as they lie, with a polygon for each."""
    own = player()
    layout, half = own.layout, own.run.task.sim.arena / 2.0
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="{-half:g} {-half:g} {2 * half:g} '
        f'{2 * half:g}" width="{_SVG}" height="{_SVG}">'
    ]
    for k, own_corners in enumerate(_each(layout, tokens)):
        points = " ".join(f"{x:.{_DIGITS}g},{-y:.{_DIGITS}g}" for x, y in own_corners.tolist())
        red, green, blue = colour_of(k)
        lines.append(f'<polygon points="{points}" fill="rgb({red},{green},{blue})"/>')
    return "\n".join([*lines, "</svg>", ""]).encode()


def puzzle_file(tokens: Sides, name: str) -> bytes:
    """A puzzle file of the tokens as they lie, for tangram-play and tangram-eval.

    Raises:
        ConfigError: the tokens are no figure, for example because they overlap.
    """
    own = player()
    layout, scale = own.layout, own.run.task.tokens.scale
    pieces = [
        {"shape": shape.name, "corners": (corners / scale).round(_DIGITS).tolist()}
        for shape, corners in zip(layout.shapes, _each(layout, tokens), strict=True)
    ]
    content = {"format": FORMAT, "version": VERSION, "puzzles": [{"name": name, "pieces": pieces}]}
    text = json.dumps(content)
    try:
        parse_puzzles(text, "the figure")  # a file that cannot be read again is not saved
    except ConfigError as error:
        first = str(error).partition(";")[0]
        raise ConfigError(f"this is no puzzle, and was not saved: {first}") from None
    return text.encode() + b"\n"


def _each(layout: Layout, tokens: Sides) -> list[Floats]:
    """The corners (V, 2) of each token."""
    corners = layout.corners(*tokens)
    return [corners[layout.corners_of(k)] for k in range(layout.tokens)]
