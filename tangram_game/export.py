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
OBSERVATIONS, CLOSE = 1000, 1e-5  # compared with torch; largest difference of an action
OUTPUT, MOST_TIES = "action", 0.01
FAILED = (
    state.Fail,
    state.InvalidArgument,
    state.InvalidGraph,
    state.NotImplemented,
    state.RuntimeException,
)
_NEAR, _ROUNDING = 64, 1e-5  # disturbed copies of an observation, and the disturbance
_NO_TIE = 1e-2  # a smaller difference is not another choice


def export_run(config: ExportConfig, tell: Callable[[str], None] = print) -> int:
    """Write an agent as ONNX if its actions equal those in torch; returns exit status 0.

    Raises:
        RunError: the run is missing or corrupt, the file is not writable, or actions differ.
        ConfigError: the agent is more than a network.
    """
    torch.set_num_threads(1)
    run = load_changed(config.run_dir, config.changes)
    content = exported(run)
    found = compared(run, content)
    if not (found.apart <= CLOSE and found.ties <= MOST_TIES * found.count):
        raise RunError(
            f"{config.out} is not written, its actions differ from those of torch: by "
            f"{found.apart:.1e}, at most {CLOSE:g} allowed; {found.ties} of {found.count} are "
            f"ties, at most {MOST_TIES:.0%} allowed: try the versions of onnx and onnxruntime "
            "in constraints.txt, or play the run by tangram_agent.runs.load_run"
        )
    write_whole(Path(config.out), content)
    spec = run.setup.spec
    sides = {name: ", ".join(map(str, spec.field(name).shape)) for name in inputs(run)}
    seen = ", ".join(f"{name} (B, {own})" for name, own in sides.items())
    tell(f"{config.out}: {OUTPUT} (B, {spec.action_size}) of {seen}, all float32")
    ties = f"; {found.ties} ties, of equal worth, are decided otherwise" if found.ties else ""
    tell(f"checked: {found.count} actions differ from torch by at most {found.apart:.1e}{ties}")
    return 0


def inputs(run: Run) -> tuple[str, ...]:
    """Names of the agent's inputs: the fields that the task's environments show."""
    return tuple(field.name for field in run.setup.spec.fields if field.per != "step")


def exported(run: Run) -> bytes:
    """Content of the ONNX file: inputs named as the task's fields, any number of rows.

    Raises:
        ConfigError: the agent is more than a network.
    """
    network: nn.Module = run.actor.graph().eval()
    spec, rows = run.setup.spec, {0: torch.export.Dim.DYNAMIC}
    names = inputs(run)
    seen = {name: torch.zeros(2, *spec.field(name).shape) for name in names}
    with warnings.catch_warnings(), tempfile.TemporaryDirectory() as folder, torch.no_grad():
        warnings.simplefilter("ignore")  # torch warns about its own code
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
                optimize=False,  # onnxruntime does so at load; here it takes half the time
                verbose=False,
            )
        except torch.onnx.errors.OnnxExporterError as error:
            raise _unwritten(run, str(error.__cause__ or error)) from error
        path = Path(folder) / "agent.onnx"
        made.save(path)
        model = onnx.load(path)
    return _clean(model, run)


def _clean(model: onnx.ModelProto, run: Run) -> bytes:
    """Content without torch's notes of source lines, and with the run's updates and setup."""
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
    """Differences between the actions of the file and of torch.

    Attributes:
        count: number of compared observations.
        apart: largest difference of an action, without ties.
        ties: observations with two actions of equal worth, of which the file takes the other.
    """

    count: int = 0
    apart: float = 0.0
    ties: int = 0


def compared(run: Run, content: bytes) -> Compared:
    """Compare actions on `OBSERVATIONS` observations of real play, on one thread each.

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
        found.apart = float(np.maximum(found.apart, apart.max()))  # np.maximum keeps nan
        return own

    horizon = run.setup.spec.horizon
    with closing(FixedTests(run.setup.task, -(-OBSERVATIONS // horizon), AT_ONCE)) as tests:
        tests.play(choose)
    return found


def _player(run: Run, content: bytes) -> Callable[[Arrays], Singles]:
    """A function that plays the file: observations (B, ...) float32 -> checked actions (B, A)."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.log_severity_level = 1, 4  # errors are also raised
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
            raise _unwritten(
                run, f"its actions are {actions.shape} {actions.dtype}, not {wanted} float32"
            )
        if not np.isfinite(actions).all():
            raise _unwritten(run, "its actions are not finite")
        played: Singles = actions
        return played

    return play


def _unwritten(run: Run, why: str) -> RunError:
    return RunError(
        f"{run.folder} cannot be written as ONNX: {why.strip().splitlines()[0]}: use other "
        "operations in the graph() of its actor"
    )


def _is_tie(run: Run, shown: Arrays, other: Singles) -> bool:
    """Whether torch also takes the action (A,) if the observation is off by rounding."""
    rng, near = np.random.default_rng(0), dict[str, Singles]()
    for name, one in shown.items():
        near[name] = np.repeat(one[None], _NEAR, axis=0)
        if run.setup.spec.field(name).dtype == "f4":
            near[name] += np.float32(_ROUNDING) * rng.standard_normal(near[name].shape, np.float32)
    actions = run.actor.act(near, beginning(run.setup.spec, near))
    return bool((np.abs(actions - other).max(axis=1) < 10 * _ROUNDING).any())
