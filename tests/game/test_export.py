"""Agents as ONNX files: onnxruntime plays them as torch does."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import tests.core.toy  # noqa: F401 - registers environments
from tangram_agent.runs import Run
from tangram_core.agent import Weights
from tangram_core.errors import ConfigError, RunError
from tangram_core.setup import Setup, make_setup
from tangram_game.config import ExportConfig
from tests.agent.builders import PAIR, SCENE, SMALL, setup

pytestmark = pytest.mark.slow

TOY = {"kind": "gym", "id": "Toy-v0", "imports": ["tests.core.toy"]}
TURNED = {"shapes": ["parallelogram", "large_triangle"], "scale": 0.8}
PERCEPTRON = {"kind": "mlp", "hidden": [16]}


onnx = pytest.importorskip("onnx", reason="pip install onnx onnxscript onnxruntime")
onnxruntime = pytest.importorskip("onnxruntime")
export = pytest.importorskip("tangram_game.export")


def toy(algorithm: str) -> Setup:
    agent = {"kind": "goal", "algorithm": algorithm, "hidden": [16]}
    return make_setup({"task": TOY, "agent": agent})


def run(made: Setup, seed: int = 0) -> Run:
    weights = made.agent.learner(made.task, seed, "cpu").broadcast()
    return Run(Path("runs/one"), {}, made, Weights(seed, weights))


@pytest.mark.parametrize(
    "made",
    [
        toy("td3"),
        toy("sac"),
        pytest.param(setup(PAIR, SCENE, SMALL), marks=pytest.mark.check),
        pytest.param(
            setup(TURNED, {"reapply": 1}, PERCEPTRON, allow_flip=True, mirrored=0.5),
            marks=pytest.mark.check,
        ),
    ],
    ids=["td3", "sac", "scene", "pair"],
)
def test_an_agent_plays_alike(
    made: Setup, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own, out = run(made), tmp_path / "agent.onnx"
    monkeypatch.setattr(export, "load_changed", lambda *_: own)
    export.export_run(ExportConfig("runs/one", str(out)))
    told = capsys.readouterr().out
    assert [line.split()[0] for line in told.splitlines()] == [f"{out}:", "checked:"]
    model = onnx.load(out)
    assert next((one.domain, one.version) for one in model.opset_import) == ("", export.OPSET)
    assert str(Path.cwd()).encode() not in out.read_bytes()  # no path of this machine
    session = onnxruntime.InferenceSession(out)
    spec = made.spec
    wanted = {f.name: ["rows", *f.shape] for f in spec.fields if f.per != "step"}
    assert {one.name: one.shape for one in session.get_inputs()} == wanted
    alone = session.run(["action"], {n: np.zeros((1, *s[1:]), "f4") for n, s in wanted.items()})
    assert alone[0].shape == (1, spec.action_size)

    # What plays otherwise is not written, be it by little.
    content = out.read_bytes()
    out.unlink()
    monkeypatch.setattr(export, "exported", lambda _: content)
    play = own.actor.act
    monkeypatch.setattr(own.actor, "act", lambda *seen: play(*seen) - np.float32(5e-5))
    with pytest.raises(RunError, match="by 5.0e-05, at most 1e-05 allowed"):
        export.export_run(ExportConfig("runs/one", str(out)))
    own = run(made, seed=1)
    with pytest.raises(RunError, match="is not written, its actions differ from those of torch"):
        export.export_run(ExportConfig("runs/one", str(out)))
    assert not out.exists()


@pytest.mark.parametrize(
    ("node", "options", "why"),
    [
        ("Cast", {"to": 11}, "its actions are .* float64, not .* float32"),
        ("Squeeze", {}, r"its actions are \(2,\) float32, not \(1, 2\)"),
        ("Log", {}, "its actions are not finite"),
        ("NoSuchNode", {}, "cannot be written as ONNX: .*NoSuchNode"),
    ],
)
def test_what_gives_no_actions_is_refused(node: str, options: dict[str, int], why: str) -> None:
    """In a file of one node that takes the observation for the action."""
    kind = onnx.TensorProto.DOUBLE if node == "Cast" else onnx.TensorProto.FLOAT
    seen = onnx.helper.make_tensor_value_info("observation", onnx.TensorProto.FLOAT, ["rows", 2])
    action = onnx.helper.make_tensor_value_info("action", kind, None)
    made = onnx.helper.make_node(node, ["observation"], ["action"], **options)
    graph = onnx.helper.make_graph([made], "one", [seen], [action])
    opset = onnx.helper.make_opsetid("", export.OPSET)
    model = onnx.helper.make_model(graph, opset_imports=[opset], ir_version=9)
    with pytest.raises(RunError, match=why):
        export._player(run(toy("td3")), model.SerializeToString())(
            {"observation": -np.ones((1, 2), "f4")}
        )


def test_a_tie_is_where_torch_plays_so_a_hair_beside() -> None:
    own = run(toy("td3"))
    own.actor.act = lambda seen, _: np.where(seen["observation"] > 0, 0.5, -0.5)
    shown = {name: np.zeros(2, "f4") for name in export.inputs(own)}
    assert export._is_tie(own, shown, np.array([-0.5, 0.5]))
    assert not export._is_tie(own, shown, np.array([-0.5, 0.4]))
    shown["observation"] += 0.01
    assert not export._is_tie(own, shown, np.array([-0.5, 0.5]))


@pytest.mark.parametrize("name", ["hand", "tangram7_silhouette"])
def test_who_searches_is_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="Actor is more than a network: .* play it with"):
        export.export_run(ExportConfig(f"pretrained/{name}", str(tmp_path / "agent.onnx")))


def test_what_onnx_does_not_know_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    class Odd(torch.nn.Module):
        def forward(self, seen: dict[str, torch.Tensor]) -> torch.Tensor:
            return seen["observation"].sort(dim=1, stable=True).values

    own = run(toy("td3"))
    monkeypatch.setattr(own.actor, "graph", Odd)
    with pytest.raises(
        RunError, match="runs/one cannot be written as ONNX: .*sort.*: use other operations"
    ):
        export.exported(own)


def test_only_an_onnx_file_is_written() -> None:
    with pytest.raises(ConfigError, match=r"out must end with .onnx, got 'a.pt': set out=agent"):
        ExportConfig("pretrained/square", "a.pt")


def test_what_is_not_installed_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tangram_game.config.find_spec", lambda name: name == "onnx" or None)
    with pytest.raises(ConfigError, match="pip install onnxscript onnxruntime$"):
        ExportConfig("pretrained/square")


@pytest.mark.filterwarnings("ignore:.torch.jit:DeprecationWarning")
@pytest.mark.parametrize("made", [toy("td3"), toy("sac"), setup(PAIR, SCENE), setup(PAIR)])
def test_a_trace_is_refused(made: Setup) -> None:
    own = run(made)
    shapes: dict[str, Any] = {name: made.spec.field(name).shape for name in export.inputs(own)}
    seen = {name: torch.zeros(2, *shape) for name, shape in shapes.items()}
    with pytest.raises(ConfigError, match="use tangram-export"):
        torch.jit.trace(own.actor.graph(), (seen,))
