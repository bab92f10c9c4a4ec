"""How a silhouette is filled: by a search, and by a beam whose states an agent judges."""

from collections.abc import Sequence
from functools import cached_property
from typing import TYPE_CHECKING, cast

from tangram_agent.pretrained import PREFIX
from tangram_agent.runs import Run, load_run, read_changed
from tangram_core.arrays import Floats
from tangram_sim.geometry.areas import Area
from tangram_sim.geometry.layout import Layout
from tangram_vision.silhouettes.silhouettes import Method

if TYPE_CHECKING:  # needs torch
    from torch import nn

    from tangram_agent.agents.outline.actor import OutlineActor
    from tangram_agent.agents.outline.filler import Fillable

JUDGE = f"{PREFIX}/tangram7_silhouette"


class Learned:
    """Values of the agent of outlines, which is loaded when it is asked first."""

    def __init__(self, layout: Layout) -> None:
        self._layout = layout

    def __call__(self, rests: Sequence[Area], left: Sequence[tuple[int, ...]]) -> Floats:
        """See `tangram_agent.agents.outline.filler.Fillable`."""
        return self._fillable(rests, left)

    @cached_property
    def _fillable(self) -> "Fillable":
        # Only here: most silhouettes are filled before anything learned is asked.
        import torch  # noqa: PLC0415

        from tangram_agent.agents.outline.filler import Fillable  # noqa: PLC0415

        torch.set_num_threads(1)  # more are slower for so little, above all beside other work
        return Fillable(_network(load_run(JUDGE)), self._layout)


def together(layout: Layout) -> Method:
    """By the search, then by the beam of the agent of outlines that comes with the package.

    Of other tokens than those that it learned with, of any size, those in which the largest tokens
    lie are followed.
    """
    learned = [shape.name for shape in read_changed(JUDGE, {}).task.layout.shapes]
    known = [shape.name for shape in layout.shapes] == learned
    return Method(values=Learned(layout) if known else None)


def _network(run: Run) -> "nn.Module":
    """What an agent of outlines learned."""
    return cast("OutlineActor", run.actor).network
