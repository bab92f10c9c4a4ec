"""The process that plays: explores with the newest weights, sends whole episodes."""

import math
from contextlib import closing

from tangram_core.errors import TangramError
from tangram_core.setup import Setup
from tangram_core.spec import Episodes
from tangram_core.wire.arrays import most_episodes
from tangram_core.wire.messages import Go
from worker.config import WorkerConfig
from worker.play.rollout import Rollout, exploring, parts
from worker.play.session import Acting, Report, joined
from worker.talk.client import Client


def run_player(config: WorkerConfig, setup: Setup) -> int:
    """Play until the master or a signal ends it.

    Returns:
        Exit status 0.

    Raises:
        TangramError: a setting that cannot work, or a master that refuses or is gone for long.
    """
    acting = Acting(setup.agent.actor(setup.task))
    # What is too large for a message is split.
    service, horizon = config.service, setup.spec.horizon
    size = min(service.batch_episodes(horizon), most_episodes(setup.spec))
    with (
        closing(setup.task.make(service.envs_for(horizon), "play")) as env,
        joined(config, setup, acting.actor) as client,
    ):
        if client.stopped:
            return 0
        report = Report()
        with report.waiting("no weights yet"):
            first = client.wait_for_weights()
        if first is None:
            return 0
        acting.follow(first)
        me = client.welcome
        if me.lockstep:
            # Nothing may depend on how often a process was started.
            alike = Rollout(env, setup.spec, me.seed, config.role, me.index, 0)
            _play_in_step(client, acting, alike, report)
            return 0
        rollout = Rollout(env, setup.spec, me.seed, config.role, me.index, me.incarnation)
        while _wait_for_room(client, report):
            # Weights change here and nowhere else: a batch is played with one version.
            newest = client.newest_weights()
            if newest is not None:
                acting.follow(newest)
            episodes = _play(rollout, acting, client, groups=math.ceil(size / env.count))
            for batch in parts(episodes, size):
                if not client.send(batch, acting.version):
                    break
            client.stats = report.played(episodes.count, acting.version)
    return 0


def _play_in_step(client: Client, acting: Acting, rollout: Rollout, report: Report) -> None:
    """Play what is ordered, with the weights that are ordered, until the client is stopped."""
    done: Go | None = None
    while (order := client.wait_for_order(done)) is not None:
        if order.episodes % rollout.envs:
            raise TangramError(
                f"the master's lockstep asks for {order.episodes} episodes, no multiple of "
                f"service.envs={rollout.envs}: start this worker with the master's service settings"
            )
        while acting.version != order.version:
            with report.waiting("the weights of this round"):
                newest = client.wait_for_weights()
            if newest is None:
                return
            acting.follow(newest)
        rollout.episode = order.first_episode
        episodes = _play(rollout, acting, client, groups=order.episodes // rollout.envs)
        if episodes.count < order.episodes or not client.send(episodes, acting.version):
            return
        client.stats = report.played(episodes.count, acting.version)
        done = order


def _wait_for_room(client: Client, report: Report) -> bool:
    """Wait until one more batch may be on its way; False if the client was stopped."""
    client.poll()
    if client.window_free > 0:
        return not client.stopped
    with report.waiting("the master is behind, nothing more is played before it has caught up"):
        return client.wait_for_window()


def _play(rollout: Rollout, acting: Acting, client: Client, groups: int) -> Episodes:
    """So many groups of episodes, fewer if the client is stopped."""

    def go_on() -> bool:
        client.poll()
        return not client.stopped

    return rollout.play(exploring(acting.actor), groups, go_on)
