"""tangram-export: an agent as an ONNX file, which onnxruntime plays without torch.

Legend: B observations, A entries of an action.
"""

import json
import logging
import tempfile
import warnings
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import torch
from onnxruntime.capi import onnxruntime_pybind11_state as state  # its errors
from torch import nn

from tangram_agent.runs import Run, beginning, load_changed
from tangram_core.agent import AT_ONCE
from tangram_core.arrays import Singles
from tangram_core.errors import RunError
from tangram_core.spec import Arrays
from tangram_core.store.files import write_whole
from tangram_core.task import Generators, History
from tangram_game.config import ExportConfig
from worker.score.test_set import FixedTests

OPSET = 20  # of ONNX 1.15, 2023
OBSERVATIONS, CLOSE = 1000, 1e-5  # that must agree so well with torch
OUTPUT, MOST_TIES = "action", 0.01
FAILED = (
    state.Fail,
    state.InvalidArgument,
    state.InvalidGraph,
    state.NotImplemented,
    state.RuntimeException,
)
_NEAR, _ROUNDING = 64, 1e-5  # neighbours of an observation that are asked, and how near they are
_NO_TIE = 1e-2  # what is less off is no other choice


def export_run(config: ExportConfig, tell: Callable[[str], None] = print) -> int:
    """Write an agent as ONNX once it plays as in torch; returns exit status 0.

    Raises:
        RunError: the run is missing or corrupt, the file is not writable, or it plays otherwise.
        ConfigError: the agent is more than a network.
    """
    torch.set_num_threads(1)
    run = load_changed(config.run_dir, config.changes)
    content = exported(run)
    found = compared(run, content)
    if not (found.apart <= CLOSE and found.ties <= MOST_TIES * found.count):
        raise RunError(
            f"{config.out} is not written, it plays otherwise than torch: an action is "
            f"{found.apart:.1e} off, {CLOSE:g} is the most; {found.ties} of {found.count} are "
            f"ties, {MOST_TIES:.0%} is the most: try the versions of onnx and onnxruntime that "
            "constraints.txt names, or play it by tangram_agent.runs.load_run"
        )
    write_whole(Path(config.out), content)
    spec = run.setup.spec
    sides = {name: ", ".join(map(str, spec.field(name).shape)) for name in inputs(run)}
    seen = ", ".join(f"{name} (B, {own})" for name, own in sides.items())
    tell(f"{config.out}: {OUTPUT} (B, {spec.action_size}) of {seen}, all float32")
    ties = f"; {found.ties} ties, of equal worth, go another way" if found.ties else ""
    tell(f"in {found.count} observations at most {found.apart:.1e} off what torch plays{ties}")
    return 0


def inputs(run: Run) -> tuple[str, ...]:
    """The names of what it sees: the fields that the task's environments show."""
    return tuple(field.name for field in run.setup.spec.fields if field.per != "step")


def exported(run: Run) -> bytes:
    """The file: inputs by the names of the task's fields, any number of rows at a time.

    Raises:
        ConfigError: the agent is more than a network.
    """
    network: nn.Module = run.actor.graph().eval()
    spec, rows = run.setup.spec, {0: torch.export.Dim.DYNAMIC}
    names = inputs(run)
    seen = {name: torch.zeros(2, *spec.field(name).shape) for name in names}
    with warnings.catch_warnings(), tempfile.TemporaryDirectory() as folder, torch.no_grad():
        warnings.simplefilter("ignore")  # of torch, at its own code
        torch._logging.set_logs(all=logging.ERROR)  # type: ignore[attr-defined]
        logging.getLogger("torch.onnx").setLevel(logging.ERROR)
        try:
            made = torch.onnx.export(
                network,
                (),
                kwargs={"seen": seen},
                input_names=names,
                output_names=(OUTPUT,),
                dynamic_shapes={"seen": dict.fromkeys(names, rows)},
                opset_version=OPSET,
                dynamo=True,
                optimize=False,  # onnxruntime does, when it loads it; here it takes half the time
                verbose=False,
            )
        except torch.onnx.errors.OnnxExporterError as error:
            raise _unwritten(run, str(error.__cause__ or error)) from error
        path = Path(folder) / "agent.onnx"
        made.save(path)
        model = onnx.load(path)
    return _clean(model, run)


def _clean(model: onnx.ModelProto, run: Run) -> bytes:
    """Without the lines of code that torch notes at each node, with what it is of."""
    for graph in (model.graph, *model.functions):
        for node in graph.node:
            del node.metadata_props[:]
            node.doc_string = ""
        del graph.metadata_props[:]
    for value in (*model.graph.input, *model.graph.output):
        value.type.tensor_type.shape.dim[0].dim_param = "rows"
    del model.metadata_props[:]
    told = {"updates": str(run.updates), "setup": json.dumps(run.setup.contents())}
    onnx.helper.set_model_props(model, told)
    content: bytes = model.SerializeToString()
    return content


@dataclass
class Compared:
    """How observations of real play are answered, beside torch.

    Attributes:
        count: of them.
        apart: how far an action is off, at most, ties left out.
        ties: of two choices of equal worth another one.
    """

    count: int = 0
    apart: float = 0.0
    ties: int = 0


def compared(run: Run, content: bytes) -> Compared:
    """Play so many observations in both ways, on one thread each.

    Raises:
        RunError: the file cannot be played, or gives no actions.
    """
    play, found = _player(run, content), Compared()

    def choose(seen: Arrays, past: History, _: Generators) -> Singles:
        shown = {name: np.asarray(seen[name], np.float32) for name in inputs(run)}
        own = run.actor.act(shown, past)
        other = play(shown)
        if not found.count:
            play({name: one[:1] for name, one in shown.items()})
        apart = np.abs(own - other).max(axis=1)
        for row in np.flatnonzero(apart > _NO_TIE):
            if _is_tie(run, {name: one[row] for name, one in shown.items()}, other[row]):
                found.ties, apart[row] = found.ties + 1, 0.0
        found.count += len(own)
        found.apart = float(np.maximum(found.apart, apart.max()))  # nan, if there is one
        return own

    horizon = run.setup.spec.horizon
    with closing(FixedTests(run.setup.task, -(-OBSERVATIONS // horizon), AT_ONCE)) as tests:
        tests.play(choose)
    return found


def _player(run: Run, content: bytes) -> Callable[[Arrays], Singles]:
    """Who plays the file: observations (B, ...) float32 -> actions (B, A), which are checked."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.log_severity_level = 1, 4  # an error is raised, too
    size = run.setup.spec.action_size
    try:
        session = onnxruntime.InferenceSession(content, options)
    except FAILED as error:
        raise _unwritten(run, str(error)) from error

    def play(shown: Arrays) -> Singles:
        try:
            (actions,) = session.run(None, shown)
        except FAILED as error:
            raise _unwritten(run, str(error)) from error
        wanted = (len(next(iter(shown.values()))), size)
        if actions.shape != wanted or actions.dtype != np.float32:
            raise _unwritten(run, f"it gives {actions.shape} {actions.dtype} for {wanted} float32")
        if not np.isfinite(actions).all():
            raise _unwritten(run, "it gives actions that are no numbers")
        played: Singles = actions
        return played

    return play


def _unwritten(run: Run, why: str) -> RunError:
    return RunError(
        f"{run.folder} cannot be written as ONNX: {why.strip().splitlines()[0]}: make graph() of "
        "other operations"
    )


def _is_tie(run: Run, shown: Arrays, other: Singles) -> bool:
    """Whether torch itself plays (A,) so where what it sees is off by rounding."""
    rng, near = np.random.default_rng(0), dict[str, Singles]()
    for name, one in shown.items():
        near[name] = np.repeat(one[None], _NEAR, axis=0)
        if run.setup.spec.field(name).dtype == "f4":
            near[name] += np.float32(_ROUNDING) * rng.standard_normal(near[name].shape, np.float32)
    actions = run.actor.act(near, beginning(run.setup.spec, near))
    return bool((np.abs(actions - other).max(axis=1) < 10 * _ROUNDING).any())
