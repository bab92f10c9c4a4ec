"""One update as a single graph: the gradients, the optimisers and all averages.

An update of small networks has a thousand small operations, and most of its time goes into starting
them. On a GPU they are recorded once as a CUDA graph, which is started as a whole. With
service.compile=true torch's compiler turns the update into C++ code, or into Triton kernels for the
CUDA graph. The compiled code is kept in a folder for later runs. Its numbers differ from those of
single operations in the last digits, so a run cannot change this setting.
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
# Functions of arguments and rates: inside a graph the rates are tensors, outside numbers.
Call = Callable[[Sequence[Tensor], Sequence[Tensor]], Tensor]
Called = Callable[[list[Tensor], list[float]], Tensor]

log = logging.getLogger(__name__)


def cache_folder() -> Path:
    """The folder of compiled updates, one for each version of torch and each kind of processor.

    Many machines may share a home directory, and one processor's code may not run on another. The
    environment variable TORCHINDUCTOR_CACHE_DIR comes first.
    """
    processor = Path("/proc/cpuinfo")
    found = _FLAGS.search(processor.read_bytes()) if processor.exists() else None
    kind = f"{zlib.crc32(found[1]):08x}" if found else platform.machine()
    own = Path.home() / ".cache" / "tangram-rl" / "compiled" / f"{torch.__version__}-{kind}"
    return Path(os.environ.get(_CACHE_SETTING, own))


class Whole:
    """A function as one graph: of tensors in a dataclass and rates, changing tensors in place.

    On a GPU the function is recorded as a CUDA graph. It is compiled on request.
    """

    def __init__(
        self, function: Callable[..., Tensor], changed: Sequence[Tensor], compiled: bool
    ) -> None:
        """Keep the function; the first call with each form of arguments makes a graph.

        Args:
            function: takes a dataclass and a tuple of rates.
            changed: the tensors that the function changes in place; never replace them.
            compiled: whether to use torch's compiler; otherwise the operations stay single.
        """
        if compiled:
            os.environ[_CACHE_SETTING] = str(cache_folder())
        self._function, self._changed, self._compiled = function, changed, compiled
        self._graphs: dict[Any, Called] = {}

    def __call__(self, steps: Any, rates: tuple[float | Tensor, ...]) -> Tensor:
        """The result of the function, which gets the rates as tensors."""
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
        """Make the graph for arguments of this form; no tensor is changed.

        Raises:
            RunError: the compiler fails, or its cache is damaged or cannot be written.
        """
        try:
            with self.unchanged():
                self(steps, rates)
        except (OSError, ImportError, RuntimeError) as error:
            if not self._compiled:
                raise
            why = str(error).strip().splitlines()[0] if str(error).strip() else repr(error)
            raise RunError(
                f"the update cannot be compiled ({why}): empty {cache_folder()} if it is damaged "
                "or from another machine, or set service.compile=false"
            ) from error

    @contextmanager
    def unchanged(self) -> Iterator[None]:
        """Context that restores the changed tensors at its end."""
        before = [one.detach().clone() for one in self._changed]
        try:
            yield
        finally:
            with torch.no_grad():
                for one, old in zip(self._changed, before, strict=True):
                    one.copy_(old)

    def _built(self, function: Call, tensors: list[Tensor], numbers: list[Tensor]) -> Call:
        """The function, compiled."""
        # Only here: the compiler takes seconds and 200 MB to load.
        from torch._decomp import get_decompositions  # noqa: PLC0415
        from torch._inductor import standalone_compile  # noqa: PLC0415
        from torch.fx.experimental.proxy_tensor import make_fx  # noqa: PLC0415

        count = len(tensors)

        def flat(*given: Tensor) -> tuple[Tensor]:
            return (function(given[:count], given[count:]),)

        # A bias is added by the code that reads the product, not copied to its place before.
        apart = get_decompositions([torch.ops.aten.addmm])
        with self.unchanged():  # tracing executes the function
            graph, constants = _lifted(make_fx(flat, apart)(*tensors, *numbers))
        example: list[Any] = [*constants, *tensors, *numbers]
        patches = {
            # On a CPU the code that calls the compiled pieces is C++ as well.
            "cpp_wrapper": tensors[0].device.type == "cpu",
            # Precompiled headers lie in /tmp, where other users of the machine may put files.
            "cpp_cache_precompile_headers": False,
        }
        with torch.no_grad(), warnings.catch_warnings():
            # torch advises its faster ten-bit products; poses need more precision.
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
        """The function as a CUDA graph, with fixed memory for its arguments.

        It stays single operations without a GPU, or if a graph cannot record it: for example, if
        it waits for a value.
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
            # The first call is not recorded: it has one-time work, such as the choice of kernels.
            aside.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(aside):
                call(own, rates)
            torch.cuda.current_stream().wait_stream(aside)
            try:
                with (  # the outer context restores the stream if the inner one fails
                    torch.cuda.stream(torch.cuda.current_stream()),
                    torch.cuda.graph(graph, capture_error_mode="thread_local"),
                ):
                    found = call(own, rates)
            except RuntimeError as error:
                why = str(error).partition("\n")[0]
                log.warning("updates are slow: losses() cannot be a CUDA graph: %s", why)
                return _filled(call)

        def replay(tensors: list[Tensor], values: list[float], _: Any = call) -> Tensor:
            # The default argument keeps `call`, and with it the constants that the graph reads.
            torch._foreach_copy_(own, tensors)
            for rate, value in zip(rates, values, strict=True):
                rate.fill_(value)
            graph.replay()
            return found.clone()

        return replay


def _filled(call: Call) -> Called:
    """A call with rates as numbers instead of tensors."""

    def filled(tensors: list[Tensor], values: list[float]) -> Tensor:
        device = tensors[0].device
        return call(tensors, [torch.tensor(value, device=device) for value in values])

    return filled


def _lifted(traced: GraphModule) -> tuple[GraphModule, list[Tensor]]:
    """A graph whose constants became its first arguments, and the tensors for them.

    Weights and averages are constants in a trace. As arguments they may change, and the compiled
    code also fits the next run.
    """
    graph, constants, places = traced.graph, [], {}
    first = next(iter(graph.nodes))
    for node in list(graph.nodes):
        node.meta.clear()  # metadata of another compilation
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
    """The form of an argument, equal for calls that share a graph; appends each tensor once."""
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
    """A copy with other tensors; an object that occurs twice stays one object."""
    if isinstance(part, Tensor):
        return tensors[id(part)]
    if not is_dataclass(part) or isinstance(part, type):
        return part
    if id(part) not in made:
        own = {one.name: _with(getattr(part, one.name), tensors, made) for one in fields(part)}
        made[id(part)] = replace(part, **own)
    return made[id(part)]
