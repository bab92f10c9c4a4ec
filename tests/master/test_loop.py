"""The loop around a scripted hub: what is acknowledged, learned, sent, kept, and when it ends."""

import shutil
import time
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from master import loop as loop_module
from master.record.delivery import EpisodesArrived
from master.watch import metrics as metrics_module
from master.watch.result import make_result
from tangram_core.errors import FailedError, RunError
from tangram_core.run import process as process_module
from tangram_core.run.process import Every
from tangram_core.store.checkpoints import list_checkpoints, load_checkpoint
from tangram_core.wire.messages import Go
from tests.master.builders import FakeHub, arrival, loop, scores, small_setup

pytestmark = pytest.mark.fast

MADE = small_setup()
BATCH = 4


@pytest.fixture(autouse=True)
def unhurried(monkeypatch: pytest.MonkeyPatch) -> None:
    """All updates that are due come in one go, however busy the machine is."""
    monkeypatch.setattr(loop_module, "LEARN_S", 600.0)
    monkeypatch.setattr(loop_module, "INSERT_S", 600.0)


def batches(count: int, size: int = BATCH) -> list[list[Any]]:
    """One batch in each poll."""
    return [[arrival(MADE, sequence, size)] for sequence in range(1, count + 1)]


def test_a_batch_is_acknowledged_after_its_insert(tmp_path: Path) -> None:
    hub = FakeHub(MADE, batches(3))
    made = loop(tmp_path, MADE, hub, max_updates=6)
    inserted: list[int] = []
    acknowledge = hub.acknowledge

    def noting(arrived: Any) -> None:
        inserted.append(made.guard.trainer.episodes)
        acknowledge(arrived)

    hub.acknowledge = noting  # type: ignore[method-assign]
    assert made.run() == "max_updates=6"
    assert hub.values("acknowledge") == [1, 2, 3]
    assert inserted == [4, 8, 12]
    twins = len(MADE.agent.config.hindsight) + 1
    assert made.guard.trainer.learner.replay.added == 12 * twins


def test_what_the_disk_does_not_take_is_not_acknowledged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hub = FakeHub(MADE, batches(1))
    made, kept = loop(tmp_path, MADE, hub), iter([False, True])
    monkeypatch.setattr(made.checkpointer, "keep", lambda _: next(kept))
    made.receive(0.0)
    for acknowledged in ([], [1]):
        made.insert()
        assert hub.values("acknowledge") == acknowledged


def test_batches_wait_unacknowledged_while_the_learner_is_behind(tmp_path: Path) -> None:
    """4 transitions are worth 2 updates, and 2 updates of lag are allowed."""
    hub = FakeHub(MADE, [[arrival(MADE, i, BATCH) for i in (1, 2, 3)]])
    made = loop(tmp_path, MADE, hub, max_updates=6)
    made.receive(0.0)
    for _ in range(3):
        made.insert()
    assert hub.values("acknowledge") == [1]
    for expected in (2, 4, 6):
        made.learn()
        assert made.guard.trainer.updates == expected
        made.insert()
    assert hub.values("acknowledge") == [1, 2, 3]


def test_each_key_has_an_equal_share_of_what_is_learned_from(tmp_path: Path) -> None:
    greedy = [replace(arrival(MADE, i, BATCH), owner="m") for i in range(1, 9)]
    other = [replace(arrival(MADE, i, BATCH), owner="a") for i in range(11, 14)]
    made = loop(tmp_path, MADE, hub := FakeHub(MADE, [greedy + other]), lag_updates=64)
    made.receive(0.0)
    made.insert()
    assert hub.values("acknowledge") == [1, 11, 2, 12, 3, 13, 4, 5, 6, 7, 8]


def test_what_a_revoked_key_sent_before_is_not_learned_from(tmp_path: Path) -> None:
    script = [replace(arrival(MADE, i, BATCH), owner="revoked" if i != 2 else "a") for i in (1, 2)]
    made = loop(tmp_path, MADE, hub := FakeHub(MADE, [script]), lag_updates=64)
    made.receive(0.0)
    made.insert()
    assert hub.values("acknowledge") == [2]
    assert made.guard.trainer.episodes == BATCH


def test_inserts_stop_for_the_sockets_and_go_on_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hub = FakeHub(MADE, [[arrival(MADE, i, BATCH) for i in range(1, 4)]])
    made = loop(tmp_path, MADE, hub, lag_updates=64)
    monkeypatch.setattr(loop_module, "INSERT_S", 0.0)
    made.receive(0.0)
    assert made.insert()
    assert hub.values("acknowledge") == [1]


def test_sockets_are_served_between_updates(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hub = FakeHub(MADE, batches(1, 40))
    made = loop(tmp_path, MADE, hub, lag_updates=64, max_updates=20)
    monkeypatch.setattr(loop_module, "LEARN_S", 0.09)
    clock = iter(np.arange(0.0, 1e5, 0.02))  # every look at the clock takes 20 ms
    monkeypatch.setattr(loop_module.time, "monotonic", lambda: float(next(clock)))
    at_polls: list[int] = []
    hub.on_poll = lambda: at_polls.append(made.guard.trainer.updates)
    made.run()
    assert at_polls[-1] == 16
    assert np.diff(at_polls).max() == 4


@pytest.mark.parametrize(
    ("bounds", "reason", "episodes", "updates"),
    [
        ({"max_updates": 3}, "max_updates=3", 8, 3),
        # The updates that the last episodes are worth are made before the end.
        ({"max_episodes": 8}, "max_episodes=8", 8, 4),
        ({"max_episodes": 6}, "max_episodes=6", 8, 4),
        ({"max_episodes": 8, "max_updates": 1}, "max_updates=1", 4, 1),
    ],
)
def test_the_bounds_end_it(
    tmp_path: Path, bounds: dict[str, int], reason: str, episodes: int, updates: int
) -> None:
    hub = FakeHub(MADE, batches(9))
    made = loop(tmp_path, MADE, hub, **bounds)
    assert made.run() == reason
    assert (made.guard.trainer.episodes, made.guard.trainer.updates) == (episodes, updates)


def test_episodes_beyond_the_bound_are_not_taken(tmp_path: Path) -> None:
    hub = FakeHub(MADE, [[arrival(MADE, i, BATCH) for i in range(1, 6)]])
    made = loop(tmp_path, MADE, hub, lag_updates=64, max_episodes=8)
    made.run()
    assert hub.values("acknowledge") == [1, 2]
    assert made.guard.trainer.updates == 4


def test_hours_end_it(tmp_path: Path) -> None:
    made = loop(tmp_path, MADE, FakeHub(MADE), max_hours=1.0)
    made.clock.record.loop_s = 3599.99
    assert made.run() == "max_hours=1"
    assert made.clock.record.loop_s == pytest.approx(3600.0, abs=10.0)
    assert made.clock.record.train_s == 0.0


def test_a_signal_ends_it(tmp_path: Path) -> None:
    hub = FakeHub(MADE)
    made = loop(tmp_path, MADE, hub)
    hub.on_poll = lambda: setattr(made.signals, "reason", "SIGTERM" if hub.polls == 3 else None)
    assert made.run() == "SIGTERM"
    assert hub.polls == 3


@pytest.mark.parametrize(
    ("service", "updates", "versions"),
    [
        ({"publish_seconds": 1000.0}, 4, [0, 4]),
        ({"publish_seconds": 0.0}, 4, [0, 1, 2, 3, 4]),
        ({"publish_seconds": 0.0}, 0, [0]),
    ],
)
def test_weights_are_sent_once_and_at_a_bounded_rate_or_after_every_update(
    tmp_path: Path, service: dict[str, Any], updates: int, versions: list[int]
) -> None:
    hub = FakeHub(MADE, batches(updates // 2))
    made = loop(tmp_path, MADE, hub, service, max_updates=updates)
    hub.on_poll = lambda: setattr(made.signals, "reason", "SIGINT" if hub.polls > 4 else None)
    made.run()
    made.finish(launched=False)
    assert hub.values("publish") == versions


@pytest.mark.parametrize(
    ("publish_seconds", "broadcast_s", "at"),
    [
        (0.5, 0.0, [0, 2, 4, 6, 8, 10]),
        (0.5, 0.4, [0, 2, 4, 6, 8, 10]),
        (0.5, 1.2, [0, 5, 10]),
        (1.5, 1.2, [0, 6]),
        # As in the paper, however many there are.
        (0.0, 1.2, [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11]),
    ],
)
def test_weights_are_sent_less_often_where_they_are_long_on_their_way(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    publish_seconds: float,
    broadcast_s: float,
    at: list[int],
) -> None:
    """There are new ones all the time, and one looks every quarter of a second."""
    hub = FakeHub(MADE)
    made = loop(tmp_path, MADE, hub, {"publish_seconds": publish_seconds})
    hub.broadcast_s, clock = broadcast_s, 0.0
    monkeypatch.setattr(process_module.time, "clock_gettime", lambda _: clock)
    made._publish = Every(publish_seconds, at_once=True)
    for turn in range(12):
        clock, made.guard.trainer.learner.updates = turn / 4, turn
        made.publish_due()
    assert hub.values("publish") == at


@pytest.mark.parametrize("often", [False, True])
def test_weights_that_are_not_finite_are_neither_sent_nor_kept(tmp_path: Path, often: bool) -> None:
    """Once is mended, again and again ends the run; the hub of these tests takes finite ones."""
    hub = FakeHub(MADE, batches(9))
    made = loop(tmp_path, MADE, hub, {"publish_seconds": 0.0}, max_updates=9)

    def poison() -> None:
        if made.guard.trainer.updates >= 2 and (often or not made.guard.undone):
            with torch.no_grad():
                next(made.guard.trainer.learner.acting.parameters()).fill_(float("nan"))

    hub.on_poll, made.guard._keep = poison, Every(1000.0)
    with closing(made):
        if often:
            with pytest.raises(
                FailedError, match=r"not finite after \d updates .*3 times in a row"
            ):
                made.run()
            sent = hub.values("publish")
            assert sent == sorted(set(sent))
            return
        assert made.run() == "max_updates=9"
        made.finish(launched=False)
    assert (made.guard.undone, hub.values("publish")[-1]) == (1, 9)
    newest = load_checkpoint(list_checkpoints(tmp_path / "checkpoints")[-1])
    for part in ("weights", "learner"):
        assert all(np.isfinite(array).all() for array in newest.arrays[part].values())


def test_checkpoints_come_on_their_interval(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("master.checkpointer.BETWEEN", 0.0)
    hub = FakeHub(MADE, batches(3))
    service = {"checkpoint_minutes": 1e-3, "publish_seconds": 1000.0}
    made = loop(tmp_path, MADE, hub, service, max_updates=6)
    made.checkpointer._checkpoint = Every(0.0)
    made.run()
    _, path = list_checkpoints(tmp_path / "checkpoints")
    counters = load_checkpoint(path, []).counters
    assert counters["hub"]["player/0"]["sequence"] == counters["episodes"] // BATCH


def test_at_the_end_nobody_finds_the_master_any_more(tmp_path: Path) -> None:
    hub = FakeHub(MADE)
    made = loop(tmp_path, MADE, hub)
    made.folder.connection.touch()
    made.dismiss("the end")
    made.close()
    assert not made.folder.connection.exists()
    assert hub.values("stop") == ["the end"]


def test_the_final_weights_are_waited_for_and_reported(tmp_path: Path) -> None:
    hub = FakeHub(MADE, batches(2), roles=["player", "evaluator"])
    made = loop(tmp_path, MADE, hub, max_updates=4)
    reason = made.run()
    # Scores of older weights come before and behind those that count.
    older = scores(MADE, 1, reward=0.1)
    hub.script.extend([[older], [], [scores(MADE, 4, reward=0.9), older]])
    result = make_result(
        made.finish(launched=False), MADE.task.scores, made.guard.trainer.facts(), 7, reason
    )
    assert (result["scored_updates"], result["updates"]) == (4, 4)
    assert (result["mean_reward"], result["mean_reward_camera"]) == (0.9, None)
    assert (result["test_episodes"], result["workers"]) == (100.0, 1)
    with Image.open(tmp_path / "test_episodes.png") as picture:
        assert picture.width > picture.height
    assert load_checkpoint(list_checkpoints(tmp_path / "checkpoints")[-1]).updates == 4


def test_a_run_whose_folder_is_gone_ends_with_one_line_and_makes_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither scores nor curves, the picture or the result make it anew by accident."""
    monkeypatch.setattr(metrics_module, "RETRY_S", 0.0)
    folder = tmp_path / "run"
    folder.mkdir()
    made = loop(folder, MADE, FakeHub(MADE, batches(2)), max_updates=4)
    made.run()
    shutil.rmtree(folder)
    for _ in range(2):
        made.reporter.scored(scores(MADE, 4))
        made.reporter.flush(0)
        made.reporter.metrics._try(made.reporter.metrics._writer.flush)
    with pytest.raises(
        FailedError, match=r"^run_dir .*/run is gone: the run ended without a check"
    ):
        made.finish(launched=False)
    with pytest.raises(RunError, match=r"cannot write .*/test_episodes.png \(No such file or dir"):
        made.reporter.draw()
    with pytest.raises(RunError, match=r"cannot write .*/result.json \(No such file or directory"):
        made.folder.write_result({})
    made.dismiss("the end")
    made.reporter.metrics.close()
    assert not folder.exists()


def test_test_episodes_are_drawn_while_it_learns(tmp_path: Path) -> None:
    made = loop(tmp_path, MADE, FakeHub(MADE, batches(1)))
    assert not made.folder.picture.exists()
    made.reporter.scored(scores(MADE, 0))
    with Image.open(made.folder.picture) as picture:
        assert picture.format == "PNG"


@pytest.mark.parametrize(
    ("launched", "roles", "reason", "waits"),
    [
        (False, ["player"], None, False),
        (True, [], None, True),
        (True, [], "SIGTERM", False),
        (False, ["evaluator"], None, True),
        (False, ["evaluator"], "SIGTERM", True),
    ],
)
def test_who_is_waited_for(
    tmp_path: Path, launched: bool, roles: list[str], reason: str | None, waits: bool
) -> None:
    hub = FakeHub(MADE, [[], [scores(MADE, 0)]], roles)
    made = loop(tmp_path, MADE, hub)
    made.signals.reason = reason
    result = make_result(
        made.finish(launched), MADE.task.scores, made.guard.trainer.facts(), 7, "over"
    )
    assert hub.polls == 2 * waits
    assert (made.clock.record.scored_version == 0) is waits
    assert (result["scored_updates"], result["mean_reward"]) == ((0, 0.5) if waits else (None,) * 2)
    assert (tmp_path / "test_episodes.png").exists() is waits


@pytest.mark.parametrize(
    ("reason", "launched", "said"),
    [
        (
            "SIGINT",
            False,
            ["Ctrl-C (SIGINT): the run ends with a checkpoint; repeat it to end at once"],
        ),
        ("SIGTERM", False, ["SIGTERM: the run ends with a checkpoint; repeat it to end at once"]),
        ("SIGINT", True, []),
        (None, False, []),
    ],
)
def test_a_signal_is_answered_unless_a_launcher_does(
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    reason: str | None,
    launched: bool,
    said: list[str],
) -> None:
    caplog.set_level("INFO")
    made = loop(tmp_path, MADE, FakeHub(MADE, [[scores(MADE, 0)]], ["evaluator"]))
    made.signals.reason = reason
    made.finish(launched)
    assert [text for text in caplog.messages if "repeat it to end" in text] == said


def test_a_second_wish_to_end_is_not_kept_waiting(tmp_path: Path) -> None:
    hub = FakeHub(MADE, roles=["evaluator"])
    made = loop(tmp_path, MADE, hub)
    hub.on_poll = lambda: setattr(made.signals, "reason", "SIGINT")
    made.finish(launched=True)
    assert hub.polls == 1


def test_a_lost_evaluator_is_waited_for_only_so_long(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(loop_module, "SCORES_S", 0.01)
    hub = FakeHub(MADE, roles=["evaluator"])
    hub.on_poll = lambda: time.sleep(0.001)  # a real one waits, too
    made = loop(tmp_path, MADE, hub, {"eval_seconds": 0.0})
    made.finish(launched=True)
    assert made.clock.record.scored_version == -1


def test_the_learning_rate_follows_the_budget(tmp_path: Path) -> None:
    made = loop(tmp_path, MADE, FakeHub(MADE, batches(5)), max_updates=10)
    seen = []
    update = made.guard.trainer.update

    def noting(share: float) -> dict[str, float]:
        seen.append(share)
        return update(share)

    made.guard.trainer.update = noting  # type: ignore[method-assign]
    made.run()
    assert seen == pytest.approx([i / 10 for i in range(10)])


IN_STEP = {"mode": "lockstep", "envs": BATCH // 2}


def played(index: int, sequence: int) -> EpisodesArrived:
    made = arrival(MADE, 10 * index + sequence)
    return replace(made, index=index, batch=replace(made.batch, sequence=sequence))


def test_in_lockstep_rounds_are_inserted_by_index_and_learned_before_the_next(
    tmp_path: Path,
) -> None:
    """The second player is quicker; 8 transitions are worth 4 updates."""
    hub = FakeHub(MADE, [[played(1, 1)], [], [played(0, 1)], [], [played(0, 2), played(1, 2)]])
    made = loop(tmp_path, MADE, hub, IN_STEP, workers=2, max_updates=8)
    assert made.run() == "max_updates=8"
    done = [(kind, value) for kind, value in hub.log if kind != "tell"]
    first = {i: Go(0, 0, 0, BATCH) for i in range(2)}
    second = {i: Go(1, 4, BATCH, BATCH) for i in range(2)}
    assert done == [
        ("publish", 0),
        ("order", first),
        ("acknowledge", 1),
        ("acknowledge", 1),
        ("publish", 4),
        ("order", second),
        ("acknowledge", 2),
        ("acknowledge", 2),
    ]
    goals = made.guard.trainer.learner.replay.state()["goal"]
    own = len(MADE.agent.config.hindsight) + 1
    np.testing.assert_array_equal(goals[0], played(0, 1).episodes["goals"][0])
    np.testing.assert_array_equal(goals[BATCH * own], played(1, 1).episodes["goals"][0])


def test_in_lockstep_nothing_is_learned_from_half_a_round(tmp_path: Path) -> None:
    """A kill between two inserts left the first player's batch; the other one's must come first."""
    hub = FakeHub(MADE, [[], [], [], [played(1, 1)]])
    made = loop(tmp_path, MADE, hub, IN_STEP, workers=2, max_updates=4)
    made.guard.trainer.insert(played(0, 1).episodes)
    updates: list[int] = []
    hub.on_poll = lambda: updates.append(made.guard.trainer.updates)
    assert made.run() == "max_updates=4"
    assert updates[:4] == [0, 0, 0, 0]
    assert hub.values("order") == [{1: Go(0, 0, 0, BATCH)}]
