"""Speed of learner updates: compiled, on one core and on a GPU."""

import importlib
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, cast

import gymnasium
import numpy as np
import torch

from tangram_agent.agents.pair.batch import make_pairs
from tangram_agent.agents.pair.learner import PairLearner
from tangram_agent.base.ddpg import Ddpg
from tangram_core.errors import ConfigError
from tangram_core.setup import Setup
from tangram_core.store.files import check_writable
from tangram_lab.benchmarks.measure import Row, Work, rate, rates, row_of
from tangram_lab.benchmarks.setups import (
    goal_config,
    played,
    preset,
    random_transitions,
    robot,
    several,
    with_agent,
)
from tangram_lab.benchmarks.speed import still
from tangram_lab.benchmarks.speed.fetch import label

BATCHES = (64, 256)
HIDDEN, SIZE, LARGE, EPISODES = [256, 256, 256], 256, 4096, 320
TIMELINE = Path("timeline.json")  # in the current folder; Chrome's tracing and Perfetto show it


def measure_learner(runs: int) -> list[Row]:
    """Updates per second on one core, compiled, compared with uncompiled single operations."""
    name = label()  # fail at once, not after minutes, if Stable-Baselines3 is missing
    cases = [("perceptron [64, 64]", preset("mlp"), 256, 2.3)]
    cases += [("ours", preset(), size, 1.5) for size in BATCHES]
    cases += [("ours, 7 tokens", several(7), BATCHES[0], 1.5)]
    rows = []
    for one, setup, size, least in cases:
        made = with_agent(setup, batch_size=size)
        whole = updates(made, learner(made, compiled=True))
        labels, rival = ("learner", f"{one}, batch {size}, compiled", "updates/s"), updates(made)
        found = rates({"ours": whole, "theirs": rival}, runs)
        rows.append(row_of(labels, found["ours"], "single operations", found["theirs"], least))
    return [*rows, *_goal_rows(runs, name)]


def _goal_rows(runs: int, name: str) -> list[Row]:
    """The goal agent with its sampling, compared with Stable-Baselines3 and the peak of a core."""
    case, setup = goal_case(SIZE)
    compiled = goal_updates(setup, compiled=True)
    left, right = torch.rand(SIZE, HIDDEN[0]), torch.rand(HIDDEN[0], HIDDEN[1])

    def product() -> float:
        torch.mm(left, right)
        return 2e-9 * SIZE * HIDDEN[0] * HIDDEN[1]

    ways = {"ours": goal_updates(setup), "compiled": compiled, name: sb3_updates(setup)}
    found = rates({**ways, "core": product}, runs)
    labels = ("learner", case, "updates/s")
    work = goal_flops(setup) / 1e9
    pairs = zip(found["compiled"], found["core"], strict=True)
    shares = [work * ours / core for ours, core in pairs]
    whole = ("learner", f"{case}, compiled", "updates/s")
    return [
        row_of(labels, found["ours"], name, found[name]),
        row_of(whole, found["compiled"], name, found[name], 1.5),
        row_of(("learner", case, "of the core's matrix rate"), shares, least=0.7),
    ]


def goal_case(size: int) -> tuple[str, Setup]:
    """The goal agent with batches of `size`: its name in the tables, and its setup."""
    sizes = f"agent.hidden={HIDDEN}", f"agent.batch_size={size}"
    case = f"goal agent {HIDDEN}, batch {size:,}"
    return case, robot(still.ID, still.__name__, "agent=goal", *sizes)


def goal_updates(
    setup: Setup, device: str = "cpu", *, compiled: bool = False, single: bool = False
) -> Work:
    """Work of the goal agent: updates with sampling from its replay buffer."""
    made: Any = setup.agent.learner(setup.task, 0, device, compiled=compiled)
    if single:
        made._whole = made.step
    rng = {stream: np.random.default_rng(i) for i, stream in enumerate(made.streams)}
    made.insert(played(setup, EPISODES), rng)

    def work() -> int:
        made.update(0.0, rng)
        return 1

    made.prepare()
    return work


def goal_flops(setup: Setup) -> float:
    """Floating-point operations of the matrix products in a TD3 update, averaged over updates."""
    config = goal_config(setup)
    made: Any = setup.agent.learner(setup.task, 0, "cpu")
    inner = sum(a * b for a, b in pairwise(config.hidden))

    def layers(inputs: int, outputs: int) -> int:
        return 2 * (inputs * config.hidden[0] + inner + config.hidden[-1] * outputs)

    critic, actor = layers(made.size + made.actions, 1), layers(made.size, made.actions)
    # A forward pass counts once, a backward pass twice. Target networks have no backward pass, and
    # the actor's loss needs no gradient of the critic's weights.
    critics = 2 * critic * 3 + 2 * critic + actor
    return float(config.batch_size) * (critics + (3 * actor + 2 * critic) / config.actor_delay)


def sb3_updates(setup: Setup) -> Work:
    """Work of Stable-Baselines3's TD3 with hindsight, with the same sizes."""
    config = goal_config(setup)
    library: Any = importlib.import_module("stable_baselines3")
    model = library.TD3(
        "MultiInputPolicy",
        gymnasium.make(still.ID, disable_env_checker=True),
        batch_size=config.batch_size,
        buffer_size=EPISODES * still.STEPS,
        learning_starts=EPISODES * still.STEPS,
        policy_kwargs={"net_arch": list(config.hidden)},
        replay_buffer_class=library.HerReplayBuffer,
        seed=0,
        device="cpu",
    )
    model.learn(EPISODES * still.STEPS)

    def work() -> int:
        model.train(gradient_steps=1, batch_size=config.batch_size)
        return 1

    return work


def measure_gpu(runs: int, *, profile: bool = False) -> list[Row]:
    """Updates per second on a GPU, recorded as a CUDA graph, compared with alternatives.

    Args:
        runs: measurements of each rate.
        profile: whether to write TIMELINE, a second of the goal agent's updates.

    Raises:
        ConfigError: no GPU is visible, or TIMELINE cannot be written.
    """
    if not torch.cuda.is_available():
        raise ConfigError("gpu needs a GPU, and none is visible: use tangram-bench learner")
    if profile:  # at once, not after minutes
        check_writable("profile", TIMELINE.absolute())
    rows = []
    for name, made in gpu_cases().items():
        single = learner(made, "cuda")
        single._whole = single.step
        ways = {
            "ours": updates(made, learner(made, "cuda")),
            "single operations on it": updates(made, single),
            "compiled": updates(made, learner(made, "cuda", compiled=True)),
            "one core, compiled": updates(made, learner(made, compiled=True)),
        }
        found, labels = rates(ways, runs), ("gpu", f"{name}, recorded", "updates/s")
        for against, least in zip([*ways][1:], (5.0, None, None), strict=True):
            rows.append(row_of(labels, found["ours"], against, found[against], least))
        if name == f"ours, batch {BATCHES[0]}":
            rows.append(row_of(labels, found["ours"], least=600.0))
    for size, target in ((SIZE, None), (LARGE, 500.0)):
        case, setup = goal_case(size)
        ours, against = goal_updates(setup, "cuda"), "single operations on it"
        ways = {"ours": ours, against: goal_updates(setup, "cuda", single=True)}
        found, labels = rates(ways, runs), ("gpu", f"{case}, recorded", "updates/s")
        rows.append(row_of(labels, found["ours"], against, found[against]))
        rows.append(row_of(labels, found["ours"], least=target))
    if profile:
        with torch.profiler.profile() as seen:
            rate(ours, span_s=1.0)
        seen.export_chrome_trace(str(TIMELINE))
        print(f"written: {TIMELINE}")
    return rows


def gpu_cases() -> dict[str, Setup]:
    """Name -> setup of the measurements on a GPU, from small to large."""
    named = [("perceptron [64, 64]", preset("mlp"), 256), ("paper's MHA", preset("paper"), 64)]
    named += [("ours, 7 tokens", several(7), BATCHES[0])]
    named += [("ours", preset(), size) for size in (*BATCHES, 2048)]
    return {
        f"{name}, batch {size}": with_agent(made, batch_size=size) for name, made, size in named
    }


def learner(setup: Setup, device: str = "cpu", *, compiled: bool = False) -> Ddpg:
    """A new learner of a setup."""
    return cast("Ddpg", setup.agent.learner(setup.task, 0, device, compiled=compiled))


def updates(setup: Setup, made: Ddpg | None = None) -> Work:
    """Work of updates on one fixed batch; without `made`, by an uncompiled learner."""
    own, generator = made or learner(setup), np.random.default_rng(0)
    batch = random_transitions(setup, own.config.batch_size)
    steps = partial(own.steps, batch, generator)
    if isinstance(own, PairLearner):  # making pairs is not measured; making tensors of them is
        pairs = make_pairs(batch, own.task.layout, own.config.hindsight, generator)
        steps = partial(own.steps_of, pairs)

    def work() -> int:
        own.learn(steps())
        return 1

    own.prepare()
    return work
