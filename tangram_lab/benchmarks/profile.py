"""Where the time of an update and of an episode goes."""

import cProfile
import io
import pstats
from contextlib import closing
from pathlib import Path

from torch.profiler import ProfilerActivity, profile

from tangram_agent.setup import Setup
from tangram_lab.benchmarks.learner import updates
from tangram_lab.benchmarks.measure import Work
from tangram_lab.benchmarks.setups import preset, several, with_sim
from tangram_lab.benchmarks.sim import Episodes

TIMES = 40
LINES = 18


def show_profile(out: Path | None) -> None:
    """Print the profiles; write them as text where `out` says."""
    parts = [_updates("update of ours, 1 token", preset())]
    parts.append(_updates("update of the paper's MHA", preset("paper")))
    parts.append(_updates("update of the paper's MLP", preset("mlp")))
    for name, setup in (("1 token", preset()), ("7 tokens", several(7))):
        with closing(Episodes(with_sim(setup, pixels=64))) as episodes:
            parts.append(_calls(f"16 episodes, {name}, 64 px", episodes.play))
    text = "\n".join(parts)
    print(text)
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(text)


def _updates(title: str, setup: Setup) -> str:
    update = updates(setup)
    for _ in range(5):
        update()
    with profile(activities=[ProfilerActivity.CPU]) as found:
        for _ in range(TIMES):
            update()
    rows = sorted(found.key_averages(), key=lambda row: -row.self_cpu_time_total)
    whole = sum(row.self_cpu_time_total for row in rows)
    lines = [f"{title}: {whole / TIMES / 1e3:.2f} ms under the profiler"]
    for row in rows[:LINES]:
        share, count = row.self_cpu_time_total / whole, row.count / TIMES
        lines.append(f"  {share:6.1%}  {count:6.0f} times  {row.key}")
    return "\n".join(lines) + "\n"


def _calls(title: str, work: Work) -> str:
    work()
    profiler = cProfile.Profile()
    profiler.enable()
    for _ in range(TIMES):
        work()
    profiler.disable()
    stream = io.StringIO()
    pstats.Stats(profiler, stream=stream).strip_dirs().sort_stats("tottime").print_stats(LINES)
    return f"{title}\n{stream.getvalue()}"
