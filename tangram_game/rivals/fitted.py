"""The formula by a model of motion that was fitted to random commands: no actor, and no critic.

Legend: B environments, K tokens, V corners.
"""

from typing import cast

import numpy as np
import torch

from tangram_agent.agents.pair.motion import Fit, MotionModel, motions_of
from tangram_core.arrays import Singles
from tangram_core.seeding import episode_generator
from tangram_core.spec import Arrays
from tangram_core.task import Chooser, Env, Generators, History
from tangram_sim.motion.actions import make_actions, velocities_of
from tangram_tasks.env import PlaceEnv
from tangram_tasks.pairing import paired
from tangram_tasks.played import Past, as_seen
from tangram_tasks.rivals.baselines import freest, random_policy
from worker.play.rollout import play

COMMANDS = 2048  # that are tried
_UPDATES = 100  # of the fit, each with all of them


def fitted_policy(of: Env) -> Chooser:
    """As `exact_policy`, by a model of motion that knows some random commands and the past.

    What an agent that learns the motion scores beyond this is what actor and critic are worth.
    """
    layout, sim = cast("PlaceEnv", of).world.layout, cast("PlaceEnv", of).world.sim
    model = _fitted(cast("PlaceEnv", of))

    def choose(seen: Arrays, history: History, _generators: Generators) -> Singles:
        (corners, placed, goals), past = as_seen(seen), Past.of(history)
        belief = model.belief(motions_of(past, corners, layout, sim))
        ahead = model.ahead(belief, corners, past, layout, sim)
        pairing = paired(layout, ahead, goals)
        token, rows = freest(layout, ahead, placed, goals, pairing), np.arange(len(ahead))
        wanted = velocities_of(pairing.way[rows, token], sim).astype(np.float32)
        command = model.command(belief, torch.from_numpy(wanted)).numpy()
        return make_actions(token, command, pairing.other_side[rows, token], layout.tokens, sim)

    return choose


def _fitted(env: PlaceEnv) -> MotionModel:
    """A model that has seen `COMMANDS` of the random policy."""

    def generator(number: int) -> np.random.Generator:
        return episode_generator(0, "fitted", 0, 0, number)

    world = env.world
    chance, count = random_policy(world.layout, world.sim), -(-COMMANDS // world.horizon)
    seen = play(env, world.spec, chance, generator, count).episodes
    past = Past(seen["corners"][:, :-1], seen.actions, seen.arrays.get("seen"))
    motions = motions_of(past, seen["corners"][:, -1].astype(np.float64), world.layout, world.sim)
    model = MotionModel()
    fit = Fit(model)
    for _ in range(_UPDATES):
        fit.step(motions)
    return model
