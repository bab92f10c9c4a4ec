"""tangram-status against a real hub."""

import json
import re
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
import zmq

from master.security import make_keys
from tangram_agent.messages import RunStatus
from tangram_sim.errors import TangramError
from tests.master.dealers import Stage, staged
from tests.master.test_health import STATUS
from tests.worker.test_security import write_file
from worker.config import StatusConfig
from worker.status import ask_status, show_status

pytestmark = pytest.mark.cluster


def asked(stage: Stage, call: Any, *arguments: Any) -> Any:
    """What a call returns while the hub is served."""
    with ThreadPoolExecutor(1) as pool:
        future = pool.submit(call, *arguments)
        stage.until(future.done)
        return future.result()


def test_a_status_is_told_without_hello(tmp_path: Path) -> None:
    keys = make_keys()
    with staged(keys=keys) as stage, zmq.Context() as context:
        stage.hub.tell(STATUS)
        path = write_file(tmp_path, stage.hub, keys)
        found = asked(stage, ask_status, str(path), context)
        assert isinstance(found, RunStatus)
        assert (found.numbers, found.texts) == (STATUS.numbers, STATUS.texts)
        assert stage.hub.peers == []
        assert not stage.hub.counters["strangers"]


def test_a_status_is_told_while_the_run_ends(tmp_path: Path) -> None:
    with staged() as stage, zmq.Context() as context:
        stage.hub.tell(STATUS)
        stage.hub.stop("the end")
        assert asked(stage, ask_status, stage.hub.endpoint, context).texts == STATUS.texts


def test_what_a_person_sees(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with staged() as stage:
        stage.hub.tell(STATUS)
        path = write_file(tmp_path, stage.hub, None)
        assert asked(stage, show_status, StatusConfig(str(path))) == 0
        shown = capsys.readouterr().out
        assert shown.startswith("run r (?)\n")
        assert re.search(r"does +learning", shown)
        assert re.search(r"updates +7, ", shown)
        assert re.search(r"worker 3 +0\.5 s ago +8 behind +10 +320 +2 *\n", shown)
        assert re.search(r"evaluator 0 +1\.5 s ago +- +0 +0 +0 *\n", shown)
        assert asked(stage, show_status, StatusConfig(str(path), json=True)) == 0
        plain = json.loads(capsys.readouterr().out)
        assert (plain["run"], plain["updates"], len(plain["workers"])) == ("r", 7.0, 2)


def test_nobody_there_is_told(tmp_path: Path) -> None:
    with zmq.Context() as context:
        with pytest.raises(TangramError, match=r"no connection file at .*: no master runs there"):
            ask_status(str(tmp_path), context)
        with pytest.raises(TangramError, match=r"127\.0\.0\.1:9 has not answered for 0\.2 s"):
            ask_status("tcp://127.0.0.1:9", context, patience_s=0.2)


def test_keys_that_do_not_fit_are_told(tmp_path: Path) -> None:
    with staged(keys=make_keys()) as stage, zmq.Context() as context:
        path = write_file(tmp_path, stage.hub, make_keys())
        with pytest.raises(TangramError, match="wrong or stale connection file"):
            asked(stage, ask_status, str(path), context)
