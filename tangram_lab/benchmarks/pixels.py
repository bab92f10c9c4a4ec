"""What learning from pixels alone comes to: no tokens are looked for, a network sees the pictures.

Stable-Baselines3's DDPG with hindsight, a convolutional encoder for actor and critic each, and
pictures shifted at random as DrQ-v2 does (https://arxiv.org/abs/2107.09645). One square, one
action, 64 pixels, grey. Its reward is Eq. 14 on the pictures, and a goal of hindsight is the
picture of what was reached. Stable-Baselines3 is optional, so all of it is loaded late.
"""

import importlib
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from rich.console import Console
from torch import Tensor, nn
from torch.nn import functional

from tangram_agent.types import Past
from tangram_lab.benchmarks.measure import show, write
from tangram_lab.benchmarks.sb3 import LIBRARY, Watch, label
from tangram_lab.benchmarks.setups import preset
from tangram_sim.arrays import Bools, Floats, Pixels, Singles
from tangram_sim.batch import BatchedEnv
from tangram_sim.pictures import token_pixels
from tangram_sim.seeding import episode_generator, evaluation_generators
from tangram_sim.sight import Look
from worker.rollout import Choose, Generators, play

PIXELS, SHIFT = 64, 4  # side of a picture, and how far it is shifted at most
FEATURES, HIDDEN = 64, (256, 256)
CAPACITY, BATCH, STARTS, NOISE = 20_000, 64, 1000, 0.1
TESTS, AT_ONCE, LOOKS = 100, 25, 12
FOR_EVER = 10**9


class Camera:
    """An eye that looks for nothing and keeps the pictures that it is shown."""

    def __init__(self, tokens: int) -> None:
        self._look = Look(np.zeros((tokens, 3)), np.zeros(tokens, np.bool_), np.zeros(tokens))
        self.shown: list[Pixels] = []

    def __call__(self, picture: Pixels, _: Look | None = None) -> Look:
        """Keep it."""
        self.shown.append(picture)
        return self._look

    def last(self, count: int) -> Pixels:
        """(count, P, P) shown last; those before them are forgotten."""
        self.shown = self.shown[-count:]
        return np.stack(self.shown)


def make_tables(count: int) -> tuple[BatchedEnv, Camera]:
    """So many tables with one square each, and what photographs them."""
    setup = preset()
    sim = replace(setup.sim, pixels=PIXELS, picture="grey", observe="pictures")
    camera = Camera(setup.layout.tokens)
    return BatchedEnv(setup.layout, sim, setup.reward, count, camera), camera


class PictureEnv(gymnasium.Env[dict[str, Any], Singles]):
    """One table for Stable-Baselines3: an observation is the picture as it is, and the target's."""

    def __init__(self, seed: int) -> None:
        self._table, self._camera = make_tables(1)
        self._seed, self._episodes = seed, 0
        picture = gymnasium.spaces.Box(0, 255, (1, PIXELS, PIXELS), np.uint8)
        nothing = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)
        goals = {"achieved_goal": picture, "desired_goal": picture}
        self.observation_space = gymnasium.spaces.Dict({"observation": nothing, **goals})
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (3,), np.float32)
        self._target: Pixels = np.zeros((1, PIXELS, PIXELS), np.uint8)

    def reset(self, **_: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        """A new target and start."""
        self._table.reset([episode_generator(self._seed, "player", 0, 0, self._episodes)])
        self._episodes += 1
        state, self._target = self._camera.last(2)[:, None]
        return self._seen(state), {}

    def step(self, action: Singles) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """The only step of an episode."""
        reward = float(self._table.step(np.asarray(action, np.float64)[None]).rewards[0])
        return self._seen(self._camera.last(1)), reward, True, False, {}

    def compute_reward(self, achieved: Pixels, desired: Pixels, _: Any) -> Floats:
        """Eq. 14 of pictures (B, 1, P, P): the share of the target that is covered, as [-1, 1]."""
        lies, wanted = token_pixels(achieved[:, 0]), token_pixels(desired[:, 0])
        # A token that left the picture is a goal that nothing covers.
        total = np.maximum(np.count_nonzero(wanted, axis=(1, 2)), 1)
        rewards: Floats = 2.0 * np.count_nonzero(lies & wanted, axis=(1, 2)) / total - 1.0
        return rewards

    def close(self) -> None:
        """Close the table."""
        self._table.close()

    def _seen(self, state: Pixels) -> dict[str, Any]:
        nothing = np.zeros(1, np.float32)
        return {"observation": nothing, "achieved_goal": state, "desired_goal": self._target}


def shifted(pictures: Tensor, way: Tensor) -> Tensor:
    """Pictures (B, C, P, P), each shifted by its way (B, 2) in whole pixels from 0 to 2 SHIFT."""
    side = pictures.shape[-1]
    wide = functional.pad(pictures, [SHIFT] * 4, mode="replicate")
    rows, columns = (way[:, i, None] + torch.arange(side) for i in (0, 1))
    each = torch.arange(len(pictures))[:, None, None]
    return wide[each, :, rows[:, :, None], columns[:, None, :]].permute(0, 3, 1, 2)


def make_model(env: PictureEnv, seed: int) -> Any:
    """DDPG with hindsight; nothing is logged."""
    label()
    library = importlib.import_module(LIBRARY)
    logger = importlib.import_module(f"{LIBRARY}.common.logger").Logger(None, [])
    noise = importlib.import_module(f"{LIBRARY}.common.noise").NormalActionNoise
    base = importlib.import_module(f"{LIBRARY}.common.torch_layers").BaseFeaturesExtractor

    class Encoder(base):  # type: ignore[misc, valid-type]  # known when it runs
        """Two pictures -> features; shifted at random while it learns."""

        def __init__(self, space: Any) -> None:
            super().__init__(space, FEATURES)
            self.net = nn.Sequential(
                *(nn.Conv2d(2, 32, 3, 2), nn.ReLU(), nn.Conv2d(32, 32, 3, 2), nn.ReLU()),
                *(nn.Conv2d(32, 32, 3), nn.ReLU(), nn.Conv2d(32, 32, 3), nn.ReLU()),
                *(nn.Flatten(), nn.LazyLinear(FEATURES), nn.LayerNorm(FEATURES), nn.Tanh()),
            )
            self.net(torch.zeros(1, 2, PIXELS, PIXELS))

        def forward(self, seen: dict[str, Tensor]) -> Tensor:
            pictures = torch.cat([seen["achieved_goal"], seen["desired_goal"]], dim=1)
            if len(pictures) > 1 and self.training:
                pictures = shifted(pictures, torch.randint(0, 2 * SHIFT + 1, (len(pictures), 2)))
            features: Tensor = self.net(pictures - 0.5)
            return features

    model = library.DDPG(
        "MultiInputPolicy",
        env,
        action_noise=noise(np.zeros(3), np.full(3, NOISE)),
        batch_size=BATCH,
        buffer_size=CAPACITY,
        device="cpu",
        learning_rate=3e-4,
        learning_starts=STARTS,
        policy_kwargs={"net_arch": list(HIDDEN), "features_extractor_class": Encoder},
        replay_buffer_class=library.HerReplayBuffer,
        replay_buffer_kwargs={"n_sampled_goal": 1, "goal_selection_strategy": "final"},
        seed=seed,
        train_freq=(1, "step"),
    )
    model.set_logger(logger)
    return model


def _choose(model: Any, camera: Camera) -> Choose:
    """What the model does in our tests, from the pictures alone."""

    def choose(corners: Floats, _: Bools, _goals: Floats, _g: Generators, _past: Past) -> Singles:
        states, targets = camera.last(2 * len(corners)).reshape(2, -1, 1, PIXELS, PIXELS)
        seen = {
            "observation": np.zeros((len(corners), 1), np.float32),
            "achieved_goal": states,
            "desired_goal": targets,
        }
        actions: Singles = model.predict(seen, deterministic=True)[0]
        return actions

    return choose


def run_pixels(minutes: float, seed: int, out: Path | None) -> int:
    """Train for so long and print the reward on the way; returns the exit status, 0."""
    torch.set_num_threads(2)
    with closing(PictureEnv(seed)) as env:
        model, watch, rows = make_model(env, seed), Watch(), list[dict[str, Any]]()
        tables, camera = make_tables(AT_ONCE)
        generators = evaluation_generators(TESTS)
        exam = _choose(model, camera)

        def look(*_: object) -> bool:
            trained = watch.seconds()
            if trained >= 60.0 * minutes * len(rows) / LOOKS:
                with watch.paused():
                    overlap = play(tables, exam, generators.__getitem__, TESTS).overlap
                    rows.append(
                        {
                            "minutes": trained / 60.0,
                            "episodes": model.num_timesteps,
                            "updates": model._n_updates,
                            "mean reward": 2.0 * float(np.mean(overlap)) - 1.0,
                        }
                    )
                    told = ", ".join(f"{name} {value:.4g}" for name, value in rows[-1].items())
                    Console(stderr=True, highlight=False).print(told)
            return trained < 60.0 * minutes

        with closing(tables):
            model.learn(FOR_EVER, callback=look)
    show(f"DDPG on pixels, one square, seed {seed}: 100 fixed tests, exact polygons", rows)
    write(out, {"minutes": minutes, "seed": seed, "rows": rows})
    return 0
