"""Whole trainings end to end, against Stable-Baselines3 on the same cores, one after the other.

Speed: the same networks, batches, hindsight and one update for each transition, on the paper's
square; the best of what each side can choose (how many workers, how many environments), and no
tests on either side. How soon it plays well: each with its defaults, scored on our fixed tests,
without noise and on exact polygons; its tests take no time of its own, ours are played beside the
training, as always.
"""

import json
import statistics
import time
from dataclasses import replace
from pathlib import Path

from tangram_lab.benchmarks.measure import Bound, Row, compared, told
from tangram_lab.benchmarks.speed.sb3 import Rival, label, train_rival
from tangram_lab.benchmarks.trainings import LOOK_S, numbers_of, running

# How good it gets in the same time


STAGE = "train"
NETS = ((64, 64), (400, 300))  # ours, and the default of theirs
QUALITY_ENVS, TWINS = 16, 3
# A policy that never turns the square has 0.88: only beyond that is the angle learned.
GOALS = {0.85: Bound(least=5.0), 0.95: None}
TEST_S = 1.0  # between two tests of ours

Curve = list[tuple[float, float]]  # seconds of training, raw overlap


def measure_quality(seeds: int, cap_s: float) -> list[Row]:
    """Seconds of training until each goal, or until it was given up."""
    wanted = max(GOALS)
    rivals = [
        Rival(hidden, cap_s, wanted, QUALITY_ENVS, twins=TWINS, starts=100, gamma=0.99, tau=0.005)
        for hidden in NETS
    ]
    ours: list[Curve] = []
    theirs: list[list[Curve]] = [[] for _ in rivals]
    for seed in range(seeds):
        ours.append(_our_curve(seed, wanted))
        for rival, curves in zip(rivals, theirs, strict=True):
            curves.append(
                [(s, share) for s, share in train_rival(replace(rival, seed=seed))["curve"]]
            )
    rows = []
    for goal, bound in GOALS.items():
        best = min(range(len(rivals)), key=lambda i: _median(theirs[i], goal))
        name = f"{label()} {list(rivals[best].hidden)}"
        rows.append(_soonest(goal, ours, name, theirs[best], bound))
    return rows


def _soonest(
    goal: float, ours: list[Curve], name: str, theirs: list[Curve], bound: Bound | None
) -> Row:
    """Their time over ours; where they were given up, at least that."""
    pairs = [
        (until(mine, goal), until(other, goal)) for mine, other in zip(ours, theirs, strict=True)
    ]
    ratios = [other / mine for mine, other in pairs]
    reached, ahead = (sum(_best(c) >= goal for c in curves) for curves in (theirs, ours))
    case = f"seconds to overlap {goal:g}, ours in {ahead} and theirs in {reached} of {len(pairs)}"
    middle = statistics.median(ratios)
    best, longest = max(map(_best, theirs)), max(curve[-1][0] for curve in theirs)
    return told(
        Row(
            STAGE,
            case if reached == len(pairs) else f"{case}: at least",
            "s",
            ours=statistics.median(mine for mine, _ in pairs),
            against=f"{name}, best overlap {best:.3g} within {longest:.0f} s",
            theirs=statistics.median(other for _, other in pairs),
            ratio=middle,
            least=min(ratios),
            most=max(ratios),
            target="" if bound is None else str(bound),
            held=None if bound is None else ahead == len(pairs) and bound.holds(middle),
        )
    )


def until(curve: Curve, goal: float) -> float:
    """Seconds until a curve first reached the goal, or its last where it did not."""
    return next((seconds for seconds, share in curve if share >= goal), curve[-1][0])


def _best(curve: Curve) -> float:
    return max(share for _, share in curve)


def _median(curves: list[Curve], goal: float) -> float:
    return statistics.median(until(curve, goal) for curve in curves)


def _our_curve(seed: int, goal: float, *settings: str) -> Curve:
    """The tests of our training with its defaults, until the goal or its end."""
    with running(f"seed={seed}", f"service.eval_seconds={TEST_S}", *settings) as folder:
        while folder.joinpath("connection.json").exists():
            time.sleep(LOOK_S)
            curve = _tests(folder)
            if curve and curve[-1][1] >= goal:
                break
        return _tests(folder)


def _tests(folder: Path) -> Curve:
    path = folder / "curve.jsonl"
    texts = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    lines = [json.loads(text) for text in texts if text.endswith("}")]
    return [(line["train_s"], line["raw_overlap"]) for line in lines]


# How long it takes to get that good


SPAN_S = 12.0
WARM_UPDATES = 300.0
WORKERS, ENVS = (1, 2), (1, 16)
SMALL, LARGE = (64, 64), (256, 256, 256)
FASTER, STILL_FASTER = Bound(least=4.0), Bound(least=1.2)

Numbers = dict[str, float]


def measure_train(seeds: int, minutes: float) -> list[Row]:
    """Speed at equal sizes, and seconds until the overlap is reached.

    Args:
        seeds: trainings of each kind.
        minutes: after which one of Stable-Baselines3 for quality is given up.
    """
    label()  # says at once what is missing
    return [
        _equal(SMALL, seeds, FASTER, compiled=False),
        _equal(SMALL, seeds, FASTER),
        _equal(SMALL, seeds, STILL_FASTER, actions=2),
        _equal(LARGE, 1, None),
        _attention(seeds),
        *measure_quality(seeds, minutes * 60.0),
    ]


def _equal(
    hidden: tuple[int, ...],
    runs: int,
    bound: Bound | None,
    *,
    compiled: bool = True,
    actions: int = 1,
) -> Row:
    """Transitions in a second with the same networks.

    A lone token with two actions is never placed, only its time is up: so all transitions go on,
    and both sides ask their target networks what follows.
    """
    net = list(hidden)
    settings = [
        "agent=mlp",
        "agent.batch_size=256",
        "agent.learning_starts=256",
        f"net.hidden={json.dumps(net, separators=(',', ':'))}",
        f"sim.actions_per_token={actions}",
        f"service.compile={str(compiled).lower()}",
    ]
    rival = Rival(hidden=hidden, seconds=SPAN_S, twins=1, actions=actions)
    ours: dict[int, list[float]] = {workers: [] for workers in WORKERS}
    theirs: dict[int, list[float]] = {envs: [] for envs in ENVS}
    for seed in range(runs):
        for workers, found in ours.items():
            numbers = _pace(*settings, f"workers={workers}", f"seed={seed}")
            # One update for each transition; players may be some ahead, so updates count.
            found.append(numbers["updates"])
        for envs, found in theirs.items():
            found.append(train_rival(replace(rival, envs=envs, seed=seed))["rate"])
    workers, envs = (max(way, key=lambda n: statistics.median(way[n])) for way in (ours, theirs))
    case = f"perceptron {net}, batch 256, an update a transition, {workers} worker(s)"
    if actions > 1:
        case += ", all of them go on"
    if compiled:
        case += ", compiled"
    against = f"{label()}, {envs} environment(s)"
    return compared((STAGE, case, "transitions/s"), ours[workers], against, theirs[envs], bound)


def _attention(runs: int) -> Row:
    """The default agent, for which there is no rival of its size: compiled against as it comes."""
    ours, theirs = (
        [_pace(f"seed={n}", f"service.compile={way}")["updates"] for n in range(runs)]
        for way in ("true", "false")
    )
    labels = (STAGE, "default agent, compiled", "updates/s")
    return compared(labels, ours, "single operations", theirs)


def _pace(*settings: str) -> Numbers:
    """Transitions and updates in a second of our training, from some updates on."""
    with running(*settings, "max_updates=0", "service.eval_seconds=3600") as folder:
        while (first := numbers_of(folder))["updates"] < WARM_UPDATES:
            time.sleep(LOOK_S)
        time.sleep(SPAN_S)
        last = numbers_of(folder)
    passed = last["elapsed_s"] - first["elapsed_s"]
    return {name: (last[name] - first[name]) / passed for name in ("transitions", "updates")}
