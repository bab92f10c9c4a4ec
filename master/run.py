"""One run of the master, from its folder to its result."""

import sys
from collections.abc import Mapping
from contextlib import closing
from queue import SimpleQueue
from typing import Any

import torch

from master.checkpointer import check_resumable
from master.children import override
from master.config import MasterConfig
from master.console import Progress, make_progress, notices_from, sturdy_console
from master.loop import Loop
from master.metrics import Curve, Metrics
from master.parts import Parts, make_parts
from master.report import Reporter
from master.result import make_result, show_result
from master.rundir import RunFolder
from master.signals import StopSignals
from tangram_agent.process import Watchdog, watch_parent
from tangram_agent.setup import Setup

# A clean end after the parent's death; a large replay takes seconds to write.
GRACE_S = 30.0


def run_master(config: MasterConfig, setup: Setup, resolved: Mapping[str, Any]) -> int:
    """Learn until a bound is reached or a signal comes, and leave a finished run folder.

    Args:
        config: the master's settings.
        setup: the task and the agent.
        resolved: the whole config as plain values, for config.yaml.

    Returns:
        Exit status 0, also after SIGINT and SIGTERM.

    Raises:
        TangramError: the folder, the port or a checkpoint cannot be used, or the weights are no
            longer finite.
    """
    news: SimpleQueue[str] = SimpleQueue()
    launched = watch_parent(news.put, GRACE_S)
    torch.set_num_threads(config.service.threads)
    folder, console = RunFolder(config.run_dir), sturdy_console(sys.stdout)
    folder.prepare(config.resume)
    form = config.service.log_format
    watchdog = Watchdog(config.service.watchdog_seconds)
    with folder.lock(), StopSignals() as signals, watchdog:
        if not launched:  # the launcher wrote it, with settings of its own
            check_resumable(folder, resolved)
            folder.write_config(resolved)
        with (
            closing(make_progress(console, f"tangram · {folder.path.name}", form)) as progress,
            notices_from("master", progress),
            closing(make_parts(config, setup, folder, progress.notice, watchdog.progress)) as parts,
            closing(Metrics(folder.tensorboard, parts.trainer.updates)) as metrics,
            closing(
                Loop(parts, _reporter(parts, progress, metrics), signals, news, watchdog)
            ) as loop,
        ):
            metrics.settings(resolved)
            if not launched:
                where = override("connect", str(folder.path))
                progress.notice(f"workers join with: tangram-worker {where}")
            reason = loop.run()
            loop.finish(launched)
            result = make_result(parts, reason, loop.clock.stopped().wall_s)
            folder.write_result(result)
            metrics.hyperparameters(resolved, parts.record.scores)
            loop.dismiss(f"the run has ended ({reason})")
            if form == "json":
                progress.notice(f"the run has ended ({reason})", event="result", **result)
    if form != "json":
        show_result(console, folder, result)
    return 0


def _reporter(parts: Parts, progress: Progress, metrics: Metrics) -> Reporter:
    curve = Curve(parts.folder.curve, parts.trainer.updates)
    return Reporter(progress, metrics, curve, parts.config.service)
