"""Checks that a task or an agent keeps the promises of its interface, for its author.

    check_task(Point())
    check_agent(TD3(), Point())

Each raises an error of one line at the first broken promise. The error names the class, the method,
what was wanted and what came. Use small networks: the agent makes a few updates.

Legend: B environments, E episodes, T steps of an episode, A entries of an action.
"""

import json
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NoReturn

import numpy as np

from tangram_core.agent import Agent, Learner, Streams
from tangram_core.arrays import Singles
from tangram_core.errors import RunError, TangramError
from tangram_core.seeding import episode_generator
from tangram_core.spec import ACTIONS, OWN, REWARDS, TERMINATED, Array, Arrays, Episodes, Field
from tangram_core.task import Env, Generators, History, Played, Step, Task

Act = Callable[[Arrays, History, Generators], Singles]
CLOSE = 1e-5  # greatest difference of an action computed alone and beside other rows


class ConformanceError(TangramError):
    """A task or an agent breaks a promise of its interface."""


_AS_GOOD: dict[str, tuple[Any, ...]] = {"f4": (np.float64,), "u1": (np.bool_,)}


def check_task(task: Task, count: int = 3) -> None:
    """Check a task against `Task` and `Env`: play it with random actions in `count` environments.

    Raises:
        ConformanceError: names the class, the method, what was wanted and what came.
    """
    task.check(plays=True)
    if task.spec != task.spec:
        _fail(task, "spec", "the same spec at every call", "two that differ")
    _check_json(task, task.identity())
    env = task.make(count, "test")
    try:
        played = play(task, env, _generators(count), _random(task))
        again = play(task, env, _generators(count), _random(task))
        _check_same(env, "reset", "the same episodes from the same generators", played, again)
        _check_rewards(task, played.episodes)
        _check_score(task, played)
        for name, made in task.rivals().items():
            play(task, env, _generators(count), _watched(task, f"rivals[{name!r}]", made(env)))
    finally:
        env.close()
        env.close()
    alone = task.make(1, "test")
    try:
        for i in range(count):
            one = play(task, alone, _generators(count)[i : i + 1], _random(task))
            own = Played(
                played.episodes.at([i]), {name: fact[[i]] for name, fact in played.facts.items()}
            )
            _check_same(alone, "step", "an episode alone to equal the one beside others", own, one)
    finally:
        alone.close()


def check_agent(agent: Agent, task: Task, device: str = "cpu") -> None:
    """Check an agent against `Agent`, `Actor` and `Learner`: let it play and learn a task.

    Raises:
        ConformanceError: names the class, the method, what was wanted and what came.
    """
    agent.check(task)
    _check_json(agent, agent.identity())
    if agent.pace.updates_per_transition <= 0 or agent.pace.learning_starts < 1:
        _fail(agent, "pace", "a positive pace and start", agent.pace)
    learner = agent.learner(task, 0, device)
    _check_acting(agent, task, learner)
    actor, env = agent.actor(task), task.make(4)
    actor.load(learner.broadcast())
    try:
        episodes = play(task, env, _generators(4), actor.act).episodes
    finally:
        env.close()
    rng = _streams(learner)
    known = 0
    while known < agent.pace.learning_starts:
        known += (found := learner.insert(episodes, rng))
        if not 0 < found <= episodes.transitions:
            _fail(learner, "insert", f"1 to {episodes.transitions} transitions", found)
    for number in range(3):
        numbers = learner.update(0.0, rng)
        if not numbers or not np.isfinite(list(numbers.values())).all():
            _fail(learner, "update", "finite numbers", numbers)
        if learner.updates != number + 1:
            _fail(learner, "update", f"updates to be {number + 1}", learner.updates)
    _check_round_trip(agent, task, learner, device)
    _check_refusals(agent, task, learner, device)


def play(task: Task, env: Env, generators: Generators, act: Act) -> Played:
    """Play one episode in each environment; check each field and step against the spec."""
    spec, count = task.spec, env.count
    arrays = dict(spec.empty(count).arrays)
    seen = env.reset(generators)
    _check_seen(env, "reset", seen, [f for f in spec.fields if f.per != "step"])
    paid = np.asarray(task.rewards(seen[spec.achieved], seen[spec.desired]))
    if paid.shape != (count,):
        _fail(task, "rewards", f"shape ({count},) for {count} goals", paid.shape)
    facts = [_copied(env.facts())]
    for t in range(spec.horizon + 1):
        for field in spec.fields:
            if field.per == "moment":
                arrays[field.name][:, t] = seen[field.name]
            elif field.per == "step" and t:
                arrays[field.name][:, t - 1] = seen[field.name]
            elif field.per == "episode":
                now = seen[field.name].astype(field.dtype)
                if t and not np.array_equal(arrays[field.name], now):
                    _fail(env, "step", f"field {field.name} to stay in an episode", "another one")
                arrays[field.name][:] = seen[field.name]
        if t == spec.horizon:
            break
        moments = {f.name: arrays[f.name][:, : t + 1] for f in spec.fields if f.per == "moment"}
        actions = act(seen, History(moments, arrays[ACTIONS][:, :t]), generators)
        step = env.step(actions.copy())
        _check_step(env, step, task)
        seen, arrays[ACTIONS][:, t] = step.seen, actions
        arrays[REWARDS][:, t], arrays[TERMINATED][:, t] = step.rewards, step.terminated
        facts.append(_copied(env.facts()))
        if facts[-1].keys() != facts[0].keys():
            _fail(env, "facts", f"{sorted(facts[0])} always", sorted(facts[-1]))
    together = {name: np.stack([one[name] for one in facts], axis=1) for name in facts[0]}
    return Played(Episodes(arrays), together)


def _check_seen(env: Env, method: str, seen: Arrays, fields: list[Field]) -> None:
    if set(seen) != {field.name for field in fields}:
        _fail(env, method, f"fields {sorted(f.name for f in fields)}", sorted(seen))
    for field in fields:
        _check_array(env, method, field, seen[field.name], env.count)


def _check_step(env: Env, step: Step, task: Task) -> None:
    _check_seen(env, "step", step.seen, list(task.spec.fields))
    own = {REWARDS: step.rewards, TERMINATED: step.terminated}
    for name in OWN[1:]:
        field, array = task.spec.field(name), np.asarray(own[name])
        _check_array(env, "step", field, array.astype(field.dtype), env.count)
    if np.asarray(step.terminated).dtype != bool:
        _fail(env, "step", "terminated to be bool", np.asarray(step.terminated).dtype)


def _check_array(owner: object, method: str, field: Field, array: Array, count: int) -> None:
    wanted = (count, *field.shape)
    # float64 is rounded when it is stored, and bool becomes a number.
    if array.shape != wanted or array.dtype not in (field.dtype, *_AS_GOOD[field.dtype]):
        came = f"{array.dtype} {array.shape}"
        _fail(owner, method, f"{field.name} to be {np.dtype(field.dtype)} {wanted}", came)
    if not ((field.low <= array) & (array <= field.high)).all():  # false for NaN
        came = f"{array.min():g} to {array.max():g}"
        _fail(owner, method, f"{field.name} within {field.low:g} and {field.high:g}", came)


def _check_same(owner: object, method: str, wanted: str, one: Played, other: Played) -> None:
    for part, found in ((one.episodes.arrays, other.episodes.arrays), (one.facts, other.facts)):
        for name, array in part.items():
            if not np.array_equal(array, found[name]):
                _fail(owner, method, wanted, f"{name} that differs")


def _check_rewards(task: Task, episodes: Episodes) -> None:
    spec, size = task.spec, episodes.transitions
    after = episodes[spec.achieved][:, 1:]
    achieved = after.reshape(size, *after.shape[2:])
    desired = np.repeat(episodes[spec.desired], spec.horizon, axis=0)
    recorded = episodes.terminated.reshape(-1).astype(bool)
    found = np.asarray(task.rewards(achieved, desired))
    if found.shape != (size,):
        _fail(task, "rewards", f"shape ({size},) for {size} goals", found.shape)
    paid = episodes.rewards.reshape(-1)
    if not np.allclose(found, paid, rtol=1e-4, atol=1e-5):
        worst = int(np.abs(found - paid).argmax())
        _fail(task, "rewards", f"what the step was paid, {paid[worst]:g}", f"{found[worst]:g}")
    ended = np.asarray(task.ended(achieved, desired, recorded))
    if ended.shape != (size,) or ended.dtype != bool or not np.array_equal(ended, recorded):
        _fail(task, "ended", "bool, as recorded by the steps for their own goal", ended)
    alone = np.concatenate([task.rewards(achieved[i : i + 1], desired[i : i + 1]) for i in (0, -2)])
    if not np.allclose(alone, found[[0, -2]]):
        _fail(task, "rewards", "the same reward for a row alone", alone)
    goals = achieved[::-1].copy()
    goals[::2] = achieved[::2]  # half of the other goals are reached
    hindsight = task.rewards(achieved, goals).astype("f4")
    _check_array(task, "rewards", spec.field(REWARDS), hindsight, size)
    every = task.ended(achieved, goals, recorded)
    rows = [slice(i, i + 1) for i in range(size)]
    single = [task.ended(achieved[i], goals[i], recorded[i]) for i in rows]
    if not np.array_equal(every, np.concatenate(single)):
        _fail(task, "ended", "the same value for a row alone", "another")


def _check_score(task: Task, played: Played) -> None:
    names, found = [score.name for score in task.scores], task.score(played)
    if not names or not set(found) <= set(names) or names[0] not in found:
        _fail(
            task, "score", f"{names[0] if names else 'names'}, and others of {names}", list(found)
        )
    if not np.isfinite(list(found.values())).all():
        _fail(task, "score", "finite numbers", found)
    picture = task.draw(played)
    if picture is not None and (picture.dtype != np.uint8 or picture.shape[2:] != (3,)):
        _fail(task, "draw", "uint8 (H, W, 3) or None", f"{picture.dtype} {picture.shape}")


def _watched(task: Task, method: str, act: Act) -> Act:
    def watched(seen: Arrays, past: History, generators: Generators) -> Singles:
        found = act(seen, past, generators)
        return _checked_actions(task, task, method, found, len(generators))

    return watched


def _check_acting(agent: Agent, task: Task, learner: Learner) -> None:
    actor, weights = agent.actor(task), learner.broadcast()
    wanted = {name: tuple(shape) for name, shape in actor.shapes.items()}
    if wanted != {name: tensor.shape for name, tensor in weights.items()}:
        odd = min({*wanted.items()} ^ {(n, t.shape) for n, t in weights.items()})
        _fail(learner, "broadcast", "the names and shapes of Actor.shapes", f"{odd} on one side")
    for name, tensor in weights.items():
        if tensor.dtype != np.float32:
            _fail(learner, "broadcast", f"'{name}' to be float32", tensor.dtype)
    actor.load(weights)
    _refuses(actor, "load", lambda: actor.load(dict(list(weights.items())[1:])))
    env, count = task.make(3), 3
    try:
        seen = env.reset(_generators(count))
    finally:
        env.close()
    for explores in (False, True):

        def act(rows: slice, explores: bool = explores) -> Singles:
            own = {name: array[rows] for name, array in seen.items()}
            moments = {f.name: own[f.name][:, None] for f in task.spec.fields if f.per == "moment"}
            size = len(range(count)[rows])
            past = History(moments, np.zeros((size, 0, task.spec.action_size), np.float32))
            rng = _generators(count)[rows] if explores else None
            return _checked_actions(task, actor, "act", actor.act(own, past, rng), size)

        whole = act(slice(None))
        if not np.array_equal(whole, act(slice(None))):
            _fail(actor, "act", "the same actions from the same generators", "other actions")
        if not np.allclose(whole[1:2], act(slice(1, 2)), atol=CLOSE):
            _fail(actor, "act", "an action that does not depend on other rows", "another one alone")


def _check_round_trip(agent: Agent, task: Task, learner: Learner, device: str) -> None:
    """Check that a learner with the state and memory of another one makes the same updates."""
    state, memory = _copied(learner.state()), _copied(learner.memory())
    other = agent.learner(task, 1, device)
    other.load_state(state)
    other.load_memory(memory)
    first, second = _streams(learner), _streams(learner)
    for _ in range(2):
        numbers, found = learner.update(0.0, first), other.update(0.0, second)
        if numbers != found:
            _fail(other, "load_state", f"the numbers of an unstopped learner, {numbers}", found)
    for name, array in learner.state().items():
        if not np.array_equal(array, other.state()[name]):
            _fail(other, "load_state", f"'{name}' of an unstopped learner", "another one")
    if other.kept != learner.kept:
        _fail(other, "load_memory", f"{learner.kept} kept", other.kept)


def _check_refusals(agent: Agent, task: Task, learner: Learner, device: str) -> None:
    """Check that incomplete states, and arrays of other shapes, are refused."""
    other = agent.learner(task, 1, device)
    methods = {"load_state": other.load_state, "load_memory": other.load_memory}
    for (method, load), whole in zip(
        methods.items(), (learner.state(), learner.memory()), strict=True
    ):
        for name in whole:
            short = {own: array for own, array in whole.items() if own != name}
            _refuses(other, f"{method} without '{name}'", partial(load, short))
        name = max(whole, key=lambda own: whole[own].ndim)
        wrong = dict(whole) | {name: whole[name][..., :-1]}
        _refuses(other, f"{method} of less '{name}'", partial(load, wrong))


def _refuses(owner: object, method: str, act: Callable[[], object]) -> None:
    try:
        act()
    except RunError:
        return
    _fail(owner, method, "RunError", "none")


def _checked_actions(
    task: Task, owner: object, method: str, actions: Singles, count: int
) -> Singles:
    field = Field(ACTIONS, (task.spec.action_size,), -1.0, 1.0, "step")
    _check_array(owner, method, field, actions, count)
    return actions


def _random(task: Task) -> Act:
    """Random actions from separate generators, so that those of the episodes do not change."""
    rng: dict[int, np.random.Generator] = {}

    def act(seen: Arrays, past: History, generators: Generators) -> Singles:  # noqa: ARG001
        if not past.actions.shape[1]:
            seeds = [int(one.spawn(1)[0].integers(2**31)) for one in generators]
            rng.update({i: np.random.default_rng(seed) for i, seed in enumerate(seeds)})
        rows = [rng[i].uniform(-1.0, 1.0, task.spec.action_size) for i in range(len(generators))]
        return np.array(rows, np.float32)

    return act


def _generators(count: int) -> list[np.random.Generator]:
    return [episode_generator(0, "conformance", 0, 0, i) for i in range(count)]


def _streams(learner: Learner) -> Streams:
    return {name: np.random.default_rng([0, i]) for i, name in enumerate(learner.streams)}


def _copied(arrays: Mapping[str, Array]) -> dict[str, Array]:
    return {name: np.array(array) for name, array in arrays.items()}


def _check_json(owner: object, identity: Any) -> None:
    try:
        json.dumps(identity)
    except (TypeError, ValueError) as error:
        _fail(owner, "identity", "values that JSON can hold", error)


def _fail(owner: object, method: str, wanted: object, came: object) -> NoReturn:
    line = " ".join(str(came).split())
    raise ConformanceError(f"{type(owner).__name__}.{method}: wanted {wanted}, got {line}")
