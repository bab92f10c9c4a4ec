"""The process that plays: explores with the newest weights, sends whole episodes."""

import math
import os
from contextlib import closing
from pathlib import Path

from tangram_agent.config import RECYCLED_STATUS, ServiceConfig
from tangram_agent.messages import Go
from tangram_agent.policy import Policy
from tangram_agent.setup import Setup
from tangram_agent.types import Episodes
from tangram_sim.batch import BatchedEnv
from tangram_sim.errors import TangramError
from worker.config import WorkerConfig
from worker.link import Link
from worker.report import Report
from worker.rollout import Rollout, join_episodes, split_episodes
from worker.session import joined

DRAIN_S = 60.0
GIB = 2**30


def run_player(config: WorkerConfig, setup: Setup) -> int:
    """Play until the master or a signal ends it.

    Returns:
        Exit status 0, or RECYCLED_STATUS to be started anew.

    Raises:
        TangramError: a setting that cannot work, or a master that refuses or is gone for long.
    """
    policy, report = Policy(setup), Report()
    size = config.service.batch_episodes
    with (
        closing(BatchedEnv(setup.layout, setup.sim, setup.reward, config.service.envs)) as env,
        joined(config, setup, policy) as link,
    ):
        if not _take_first_weights(link, policy, report):
            return 0
        me = link.welcome
        if me.lockstep:
            # Nothing may depend on how often a process was started.
            _play_in_step(link, policy, Rollout(env, me.seed, config.role, me.index, 0), report)
            return 0
        rollout = Rollout(env, me.seed, config.role, me.index, me.incarnation)
        while _wait_for_room(link, report):
            # Weights change here and nowhere else: a batch is played with one version.
            newest = link.newest_weights()
            if newest is not None:
                policy.load(newest)
            episodes = _play(rollout, policy, link, groups=math.ceil(size / env.count))
            for batch in split_episodes(episodes, size):
                if not link.send(batch, policy.version):
                    break
            link.stats["episodes"] = float(rollout.episode)
            report.played(episodes.count, policy.version)
            if is_worn_out(config.service, rollout.episode) and link.drain(DRAIN_S):
                link.stop("recycled")
                return RECYCLED_STATUS
    return 0


def _play_in_step(link: Link, policy: Policy, rollout: Rollout, report: Report) -> None:
    """Play what is ordered, with the weights that are ordered, until the link is stopped."""
    done: Go | None = None
    while (order := link.wait_for_order(done)) is not None:
        if order.episodes % rollout.envs:
            raise TangramError(
                f"the master's lockstep asks for {order.episodes} episodes, no multiple of "
                f"service.envs={rollout.envs}: start this worker with the master's service settings"
            )
        while policy.version != order.version:
            with report.waiting("the weights of this round"):
                newest = link.wait_for_weights()
            if newest is None:
                return
            policy.load(newest)
        rollout.episode = order.first_episode
        episodes = _play(rollout, policy, link, groups=order.episodes // rollout.envs)
        if episodes.count < order.episodes or not link.send(episodes, policy.version):
            return
        report.played(episodes.count, policy.version)
        done = order


def is_worn_out(service: ServiceConfig, episodes: int) -> bool:
    """Whether a fresh process should go on in the place of this one."""
    limit = service.recycle_gib * GIB
    tired = 0 < service.recycle_episodes <= episodes
    return tired or 0.0 < limit <= memory_bytes()


def memory_bytes() -> int:
    """What this process holds in memory."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def _take_first_weights(link: Link, policy: Policy, report: Report) -> bool:
    """Load the first weights; False if the link was stopped before they came."""
    with report.waiting("no weights yet"):
        weights = link.wait_for_weights()
    if weights is None:
        return False
    policy.load(weights)
    return True


def _wait_for_room(link: Link, report: Report) -> bool:
    """Wait until one more batch may be on its way; False if the link was stopped."""
    link.poll()
    if link.window_free > 0:
        return not link.stopped
    with report.waiting("the master is behind, nothing more is played before it has caught up"):
        return link.wait_for_window()


def _play(rollout: Rollout, policy: Policy, link: Link, groups: int) -> Episodes:
    """So many groups of episodes, fewer if the link is stopped."""
    rollout.follow(policy.version)
    parts = [rollout.play(policy.explore)]
    while len(parts) < groups and not link.stopped:
        link.poll()
        parts.append(rollout.play(policy.explore))
    return join_episodes(parts)
