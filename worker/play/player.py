"""The player: explores with the newest weights and sends whole episodes to the master."""

import math
from contextlib import closing

from tangram_core.errors import TangramError
from tangram_core.setup import Setup
from tangram_core.spec import Episodes
from tangram_core.wire.arrays import most_episodes
from tangram_core.wire.messages import Go
from worker.config import WorkerConfig
from worker.play.rollout import Rollout, parts
from worker.play.session import Acting, Report, joined
from worker.talk.client import Client


def run_player(config: WorkerConfig, setup: Setup) -> int:
    """Play until the master or a signal stops this process.

    Returns:
        Exit status 0.

    Raises:
        TangramError: a setting cannot work, or the master refuses or does not answer for long.
    """
    acting = Acting(setup.agent.actor(setup.task))
    # Groups of episodes that are too large for one message are split.
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
            # Lockstep is reproducible: the incarnation (number of restarts) must have no effect.
            alike = Rollout(env, setup.spec, me.seed, config.role, me.index, 0)
            _play_in_step(client, acting, alike, report)
            return 0
        rollout = Rollout(env, setup.spec, me.seed, config.role, me.index, me.incarnation)
        while _wait_for_room(client, report):
            # Weights change only here, so every batch is played with one version.
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
    """Play the episodes and weights version of each order until the client is stopped."""
    done: Go | None = None
    while (order := client.wait_for_order(done)) is not None:
        if order.episodes % rollout.envs:
            raise TangramError(
                f"the lockstep master asks for {order.episodes} episodes, not a multiple of "
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
    """Wait until the window has room for a batch; False if the client was stopped."""
    client.poll()
    if client.window_free > 0:
        return not client.stopped
    with report.waiting("the master is behind, this player goes on when the master has caught up"):
        return client.wait_for_window()


def _play(rollout: Rollout, acting: Acting, client: Client, groups: int) -> Episodes:
    """Play `groups` groups of episodes, fewer if the client is stopped."""

    def go_on() -> bool:
        client.poll()
        return not client.stopped

    return rollout.play(acting.actor.act, groups, go_on)
