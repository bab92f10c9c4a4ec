"""One update as a whole: both gradients, both optimisers and all averages.

An update of small networks is a thousand small operations, and most of its time goes from one to
the next. On a GPU they are recorded once as a CUDA graph, which the processor asks for as a whole.
Compiled, the update is traced once, as it is, and torch's compiler makes one piece of C++ of it, or
kernels of Triton for the graph. What was compiled is kept in a folder for the next run; its numbers
differ from those of single operations in their last digits, so a run stays with it or without it.
"""

import logging
import os
import platform
import re
import warnings
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.fx import GraphModule

from tangram_core.errors import RunError

_CACHE_SETTING = "TORCHINDUCTOR_CACHE_DIR"
_FLAGS = re.compile(rb"^(?:flags|Features)\s*:(.*)$", re.MULTILINE)
# Of arguments and rates: as a graph takes them, and as it is called.
Call = Callable[[Sequence[Tensor], Sequence[Tensor]], Tensor]
Called = Callable[[list[Tensor], list[float]], Tensor]

log = logging.getLogger(__name__)


def cache_folder() -> Path:
    """Where compiled updates are kept: what one processor runs another one may not.

    A home is often shared by many machines, so each version of torch and each kind of processor has
    its own folder. torch's own setting comes first.
    """
    processor = Path("/proc/cpuinfo")
    found = _FLAGS.search(processor.read_bytes()) if processor.exists() else None
    kind = f"{zlib.crc32(found[1]):08x}" if found else platform.machine()
    own = Path.home() / ".cache" / "tangram-rl" / "compiled" / f"{torch.__version__}-{kind}"
    return Path(os.environ.get(_CACHE_SETTING, own))


class Whole:
    """A function of tensors in dataclasses, and of rates, that changes other tensors in place.

    On a GPU it is recorded; compiled it is where that is wanted.
    """

    def __init__(
        self, function: Callable[..., Tensor], changed: Sequence[Tensor], compiled: bool
    ) -> None:
        """Make a graph of it when it is called first, and for each form of its arguments.

        Args:
            function: of a dataclass and of a tuple of rates.
            changed: what it changes; these must stay the same tensors.
            compiled: by torch's compiler; else it stays the single operations that it is made of.
        """
        if compiled:
            os.environ[_CACHE_SETTING] = str(cache_folder())
        self._function, self._changed, self._compiled = function, changed, compiled
        self._graphs: dict[Any, Called] = {}

    def __call__(self, steps: Any, rates: tuple[float | Tensor, ...]) -> Tensor:
        """What the function gives; the rates reach it as tensors."""
        tensors: list[Tensor] = []
        form = _form(steps, tensors, {})
        values = [float(rate) for rate in rates]
        if form not in self._graphs:
            names, kind = [*map(id, tensors)], type(rates)

            def call(given: Sequence[Tensor], rates: Sequence[Tensor]) -> Tensor:
                own = dict(zip(names, given, strict=True))
                return self._function(_with(steps, own, {}), kind(*rates))

            numbers = [torch.tensor(value, device=tensors[0].device) for value in values]
            whole = self._built(call, tensors, numbers) if self._compiled else call
            self._graphs[form] = self._recorded(whole, tensors, numbers)
        return self._graphs[form](tensors, values)

    def prepare(self, steps: Any, rates: tuple[float | Tensor, ...]) -> None:
        """Make its graph for arguments of this form; nothing is changed.

        Raises:
            RunError: the compiler fails, or what it keeps is damaged or cannot be written.
        """
        try:
            with self.unchanged():
                self(steps, rates)
        except (OSError, ImportError, RuntimeError) as error:
            if not self._compiled:
                raise
            why = str(error).strip().splitlines()[0] if str(error).strip() else repr(error)
            raise RunError(
                f"the update cannot be compiled ({why}): empty {cache_folder()} if that was of "
                "another machine or is damaged, or learn with service.compile=false"
            ) from error

    @contextmanager
    def unchanged(self) -> Iterator[None]:
        """What is changed within is undone."""
        before = [one.detach().clone() for one in self._changed]
        try:
            yield
        finally:
            with torch.no_grad():
                for one, old in zip(self._changed, before, strict=True):
                    one.copy_(old)

    def _built(self, function: Call, tensors: list[Tensor], numbers: list[Tensor]) -> Call:
        """The same, compiled."""
        # Only here: the compiler takes seconds and 200 MB to load.
        from torch._inductor import standalone_compile  # noqa: PLC0415
        from torch.fx.experimental.proxy_tensor import make_fx  # noqa: PLC0415

        count = len(tensors)

        def flat(*given: Tensor) -> tuple[Tensor]:
            return (function(given[:count], given[count:]),)

        with self.unchanged():  # it is traced by doing it once
            graph, constants = _lifted(make_fx(flat)(*tensors, *numbers))
        example: list[Any] = [*constants, *tensors, *numbers]
        patches = {
            # What calls the compiled pieces one after the other is C++ as well; on a CPU alone.
            "cpp_wrapper": tensors[0].device.type == "cpu",
            # Headers compiled ahead lie in /tmp, where others of the machine may put their own.
            "cpp_cache_precompile_headers": False,
        }
        with torch.no_grad(), warnings.catch_warnings():
            # Ten bits of a product would be quicker on a GPU; a pose needs more.
            warnings.filterwarnings("ignore", "TensorFloat32")
            compiled = standalone_compile(
                graph,
                example,
                dynamic_shapes="from_example_inputs",
                options={"config_patches": patches},
            )

        @torch.no_grad()
        def call(given: Sequence[Tensor], rates: Sequence[Tensor]) -> Tensor:
            found: Tensor = compiled(*constants, *given, *rates)[0]
            return found

        return call

    def _recorded(self, call: Call, tensors: list[Tensor], numbers: list[Tensor]) -> Called:
        """The same as a CUDA graph, which has places of its own for its arguments.

        As it is where there is no GPU, or where it does what no graph can: wait for a value, say.
        """
        if not tensors[0].is_cuda:
            return _filled(call)
        given = [
            torch.empty_strided(one.shape, one.stride(), dtype=one.dtype, device=one.device)
            for one in (*tensors, *numbers)
        ]
        own, rates = given[: len(tensors)], given[len(tensors) :]
        torch._foreach_copy_(given, [*tensors, *numbers])
        graph, aside = torch.cuda.CUDAGraph(), torch.cuda.Stream()  # type: ignore[no-untyped-call]
        with self.unchanged():
            # What is done at first only must not be recorded, such as the choice of a kernel.
            aside.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(aside):
                call(own, rates)
            torch.cuda.current_stream().wait_stream(aside)
            try:
                with (  # the outer one: what fails in the inner one leaves its stream behind
                    torch.cuda.stream(torch.cuda.current_stream()),
                    torch.cuda.graph(graph, capture_error_mode="thread_local"),
                ):
                    found = call(own, rates)
            except RuntimeError as error:
                why = str(error).partition("\n")[0]
                log.warning("updates are not recorded, and slow: %s", why)
                return _filled(call)

        def replay(tensors: list[Tensor], values: list[float], _: Any = call) -> Tensor:
            # The graph reads its constants where they lie: `call` keeps them.
            torch._foreach_copy_(own, tensors)
            for rate, value in zip(rates, values, strict=True):
                rate.fill_(value)
            graph.replay()
            return found.clone()

        return replay


def _filled(call: Call) -> Called:
    """The same of rates as numbers."""

    def filled(tensors: list[Tensor], values: list[float]) -> Tensor:
        device = tensors[0].device
        return call(tensors, [torch.tensor(value, device=device) for value in values])

    return filled


def _lifted(traced: GraphModule) -> tuple[GraphModule, list[Tensor]]:
    """A graph of arguments alone, and the tensors to call it with before its own arguments.

    Weights and averages are constants in what was traced. As arguments they may change, and the
    kept code fits those of the next run.
    """
    graph, constants, places = traced.graph, [], {}
    first = next(iter(graph.nodes))
    for node in list(graph.nodes):
        node.meta.clear()  # that of another compilation
        if node.op != "get_attr":
            continue
        if node.target not in places:
            with graph.inserting_before(first):
                places[node.target] = graph.placeholder(node.target)
            constants.append(getattr(traced, node.target).detach())
        node.replace_all_uses_with(places[node.target])
        graph.erase_node(node)
    return GraphModule({}, graph), constants


def _form(part: Any, tensors: list[Tensor], seen: dict[int, int]) -> Any:
    """What two arguments of one graph have in common; their tensors are listed, each once."""
    if isinstance(part, Tensor):
        if id(part) not in seen:
            seen[id(part)] = len(tensors)
            tensors.append(part)
        return seen[id(part)], part.shape, part.stride(), part.dtype
    if is_dataclass(part):
        own = [_form(getattr(part, field.name), tensors, seen) for field in fields(part)]
        return type(part), *own
    return part


def _with(part: Any, tensors: dict[int, Tensor], made: dict[int, Any]) -> Any:
    """The same with other tensors; what was one object stays one."""
    if isinstance(part, Tensor):
        return tensors[id(part)]
    if not is_dataclass(part) or isinstance(part, type):
        return part
    if id(part) not in made:
        own = {one.name: _with(getattr(part, one.name), tensors, made) for one in fields(part)}
        made[id(part)] = replace(part, **own)
    return made[id(part)]
