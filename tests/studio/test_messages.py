"""What a page may ask for: everything else is refused in one line."""

import json

import pytest

from tangram_core.errors import ConfigError
from tangram_studio.messages import MAX_POINTS, Fill, Next, Play, Save, read

pytestmark = pytest.mark.fast

TOKENS = {"poses": [[0.0, 0.0, 0.0]] * 7, "flipped": [False] * 7}
RING = [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]
FILL = {"ask": "fill", "number": 1}
PLAY = {"ask": "play", "number": 2, "goal": TOKENS}
SAVE = {"ask": "save", "kind": "gif", "tokens": TOKENS}


@pytest.mark.parametrize(
    ("message", "kind"),
    [
        (FILL | {"puzzle": "cat"}, Fill),
        (FILL | {"outlines": [RING], "free": True}, Fill),
        (FILL | {"pieces": TOKENS}, Fill),
        (PLAY | {"start": TOKENS, "motion": "push"}, Play),
        ({"ask": "next"}, Next),
        (SAVE | {"name": "cat"}, Save),
    ],
)
def test_what_a_page_asks_for_is_read(message: dict[str, object], kind: type) -> None:
    assert isinstance(read(json.dumps(message)), kind)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "{",
        "null",
        "[" * 100_000,
        '{"ask": "stop"}',
        '{"ask": "next", "more": 1}',
        json.dumps(FILL | {"number": -1, "puzzle": "cat"}),
        json.dumps(FILL | {"number": 2**53, "puzzle": "cat"}),
        json.dumps(FILL | {"puzzle": "c" * 65}),
        json.dumps(FILL | {"puzzle": 3}),
        json.dumps(FILL | {"outlines": []}),
        json.dumps(FILL | {"outlines": [RING[:2]]}),
        json.dumps(FILL | {"outlines": [[[0.0, 0.0]] * (MAX_POINTS + 1)]}),
        json.dumps(FILL | {"outlines": [RING] * 51}),
        json.dumps(FILL | {"outlines": [[[0.0, 101.0], *RING]]}),
        json.dumps(FILL | {"outlines": [[[0.0, float("nan")], *RING]]}),
        json.dumps(FILL | {"outlines": [[[0.0, float("inf")], *RING]]}),
        json.dumps(PLAY | {"motion": "throw"}),
        json.dumps(PLAY | {"goal": TOKENS | {"poses": [[0.0, 0.0, 0.0]] * 6}}),
        json.dumps(PLAY | {"goal": TOKENS | {"flipped": [0] * 7}}),
        json.dumps(PLAY | {"goal": TOKENS | {"poses": [[0.0, 0.0, 1e9]] * 7}}),
        json.dumps(SAVE | {"kind": "exe"}),
        json.dumps(SAVE | {"kind": "gif\n"}),
    ],
)
def test_what_no_page_asks_for_is_refused_in_one_line(text: str) -> None:
    with pytest.raises(ConfigError, match="cannot read the page's message .*: reload the page"):
        read(text)
