"""How the run stands: collected once, the same everywhere, and never the end of the loop."""

from pathlib import Path

import numpy as np
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from master.watch.report import could_play
from master.watch.result import make_result
from tangram_core.run.process import Every
from tangram_core.spec import Episodes
from tests.master.builders import FakeHub, arrival, loop, scores, shown, small_setup

pytestmark = pytest.mark.fast

MADE = small_setup()


def test_what_is_told(tmp_path: Path) -> None:
    """The same status goes to the terminal, to who asks, to the curves and into the result."""
    hub = FakeHub(
        MADE, [[arrival(MADE, 1)], [arrival(MADE, 2)], [scores(MADE, 2)]], ["player", "evaluator"]
    )
    hub.broadcast_s = 0.25
    made = loop(tmp_path, MADE, hub, {"publish_seconds": 0.0}, max_updates=4)
    made.run()
    last = made.reporter.flush(queue=3)
    assert shown(made)[-1] is last
    assert hub.values("tell")[-1] is last
    expected = {
        "episodes": 8,
        "updates": 4,
        "share": 1.0,
        "players": 1,
        "evaluators": 1,
        "queue": 3,
        "broadcast_s": 0.25,
    }
    assert expected.items() <= dict(last.numbers).items()
    assert last.texts["activity"] == "waiting for episodes"
    made.reporter.metrics.close()
    events = EventAccumulator(str(tmp_path / "tensorboard"))
    events.Reload()
    expected_tags = {
        "train/critic_loss",
        "train/actor_loss",
        "train/q",
        "play/reward",
        "weights/age_updates",
        "weights/age_seconds",
    }
    of_status = {n if "/" in n else f"run/{n}" for n in last.numbers if not n.startswith("test/")}
    assert expected_tags | of_status <= set(events.Tags()["scalars"])


def test_who_takes_part_is_told_one_by_one_to_those_who_listen_only(tmp_path: Path) -> None:
    """The terminal's line needs no row for each of a thousand workers, ten times in a second."""
    hub = FakeHub(MADE, roles=["player"] * 3 + ["evaluator"])
    made = loop(tmp_path, MADE, hub)
    made.reporter._tick = Every(0.0)
    for _ in range(3):
        made.reporter.tick(0)
    rows = [len(status.workers) for status in shown(made)]
    counts = [(status.numbers["players"], status.numbers["evaluators"]) for status in shown(made)]
    assert (rows, counts) == ([4, 0, 0], [(3, 1)] * 3)
    assert [len(status.workers) for status in hub.values("tell")] == [4]


def test_what_could_be_played_is_that_of_those_who_told_for_all() -> None:
    hub = FakeHub(MADE, roles=["player"] * 3 + ["evaluator"])
    assert could_play(hub.peers, horizon=10) == 0.0
    told = [{"episodes": 100.0, "busy_s": 50.0}, {"episodes": 8.0, "busy_s": 2.0}, {}]
    for peer, stats in zip(hub.peers, [*told, {"episodes": 9.0, "busy_s": 1.0}], strict=True):
        peer.stats = stats
    assert could_play(hub.peers, horizon=10) == 10 * (2.0 + 4.0) / 2 * 3


@pytest.mark.parametrize(
    ("transitions", "updates", "players", "words"),
    [
        (0, 0, 0, "waiting for workers to join"),
        (3, 0, 1, "filling the replay, 3 of 4"),
        (4, 0, 1, "learning, faster workers wait"),
        (4, 0, 0, "learning"),
        (4, 1, 1, "learning"),
        (4, 2, 1, "waiting for episodes"),
    ],
)
def test_what_is_waited_for(
    tmp_path: Path, transitions: int, updates: int, players: int, words: str
) -> None:
    made = loop(tmp_path, MADE, FakeHub(MADE, roles=["player"] * players))
    made.guard.trainer.rate_limiter.inserted(transitions)
    made.guard.trainer.rate_limiter.updated(updates)
    made.reporter.tick(0)
    assert shown(made)[-1].texts["activity"] == words
    made.checkpointer.homeless = True
    said = "waiting for the run folder, which is gone or was replaced"
    assert made.reporter.flush(0).texts["activity"] == said


def test_it_is_told_where_nothing_can_be_learned_from(tmp_path: Path) -> None:
    made = loop(tmp_path, MADE, FakeHub(MADE, roles=["player"]))
    episodes = arrival(MADE, 1).episodes
    gone = np.zeros((4, MADE.task.spec.horizon + 1, 1), np.uint8)
    made.guard.trainer.insert(Episodes({**episodes.arrays, "seen": gone, "goals_seen": gone[:, 0]}))
    said = f"waiting for an episode to learn from: {MADE.task.waits}"
    assert made.reporter.flush(0).texts["activity"] == said
    made.guard.trainer.insert(episodes)
    assert made.reporter.flush(0).texts["activity"] == "learning, faster workers wait"


def test_a_status_that_cannot_be_told_as_it_is_ends_nothing_and_keeps_the_scores(
    tmp_path: Path,
) -> None:
    """More counters than a message takes, numbers beyond its bounds, and none at all."""
    hub = FakeHub(MADE)
    hub.counters.update({f"event{i}": 2**70 for i in range(100)})
    made = loop(tmp_path, MADE, hub)
    found = {score.name: 0.5 for score in MADE.task.scores} | {
        "coverage": float("nan"),
        "mean_reward": 1e300,
    }
    made.clock.record.score(found, version=0)
    status = made.reporter.flush(queue=0)
    assert hub.values("tell") == [status]
    status.encode()
    result = make_result(
        status, MADE.task.scores, made.guard.trainer.facts(), seed=0, reason="SIGTERM"
    )
    assert (result["coverage"], result["mean_reward"]) == (None, 1e18)
    assert result["position_error_p90"] == 0.5
