"""Processes that start at once: a server has imported torch for all of them, each is its fork.

Alone, a process takes seconds until it has imported all, and each has its own copy in memory. The
server is that of `multiprocessing`. It ends with the process that started it and all children.
"""

import multiprocessing
import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib import import_module
from multiprocessing import forkserver, resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerProcess
from pathlib import Path

from setproctitle import setproctitle

from master.signals import SIGNALS
from tangram_core.errors import TangramError, UnavailableError, is_passing
from tangram_core.run.process import VARIABLE

THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
SAFE_PATH = "PYTHONSAFEPATH"  # of the server, which must not find the modules of a user first
ROOT = Path(__file__).resolve().parent.parent
# Runs in the process, with its arguments; found again there by its name.
Body = Callable[[Sequence[str]], int]

_context = multiprocessing.get_context("forkserver")


def run_command(arguments: Sequence[str]) -> int:
    """Run tangram-NAME of this installation: arguments are the name, and its own.

    Returns:
        The exit status.
    """
    name, *rest = arguments
    sys.argv[:] = [f"tangram-{name}", *rest]
    status: int = import_module("tangram_cli.commands").COMMANDS[name]()
    return status


def warm_up() -> None:
    """Start the server, unless it runs, and wait until it can fork.

    It has this process's environment. Errors are those of `start`, which meets them again.
    """
    with Path(os.devnull).open() as nothing, suppress(TangramError):
        start(run_nothing, ["nothing"], None, 0, nothing.fileno()).join()


def run_nothing(_: Sequence[str]) -> int:
    """End well."""
    return 0


def start(
    body: Body, arguments: Sequence[str], log: Path | None, nice: int, read_end: int
) -> ForkServerProcess:
    """Start a process in a session of its own.

    Args:
        body: what it runs.
        arguments: of that, also its title, as `ps` shows it.
        log: file that its output is appended to, None for the terminal.
        nice: added to its niceness.
        read_end: of its lifeline.

    Raises:
        UnavailableError: the server was killed just now, or there is no room for a process.
        TangramError: it cannot start.
    """
    _context.set_forkserver_preload(["tangram_cli.forkserver"])
    with Connection(os.dup(read_end), writable=False) as lifeline:
        process = _context.Process(target=_become, args=(body, arguments, log, nice, lifeline))
        try:
            _ensure_server()
            process.start()
        except (EOFError, OSError) as error:
            later = isinstance(error, EOFError | ConnectionError | BlockingIOError)
            kind = UnavailableError if later or is_passing(error) else TangramError
            raise kind(
                f"no process can be started ({error}): is TMPDIR, or /tmp, a short path that can "
                "be written to, is the current folder still there, and is memory left?"
            ) from error
    return process


def _ensure_server() -> None:
    """With our environment, and signals held back from its first moment on.

    A whole job may get these: the server outlasts them, and its forks take what came meanwhile.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        resource_tracker.ensure_running()  # the server's companion; it lets some signals in again
        signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
        with _environment():
            forkserver.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _become(
    body: Body, arguments: Sequence[str], log: Path | None, nice: int, lifeline: Connection
) -> None:
    """In the child."""
    # Ctrl-C reaches the whole terminal; the parent decides who ends when.
    os.setsid()
    signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
    os.nice(nice)
    # As in a process of its own: what plug-ins may use, and what theirs inherit.
    import_module("numpy").random.seed()
    multiprocessing.set_start_method(None, force=True)
    del os.environ[SAFE_PATH]
    _redirect(os.open(os.devnull, os.O_RDONLY), 0)
    if log is not None:
        try:
            output = os.open(log, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o666)
        except OSError:  # where the disk takes no log: that is no reason to be without it
            output = os.open(os.devnull, os.O_WRONLY)
        _redirect(output, 1, 2)
    os.environ[VARIABLE] = str(os.dup(lifeline.fileno()))
    setproctitle("tangram-" + " ".join(arguments))
    sys.exit(body(arguments))


def _redirect(source: int, *numbers: int) -> None:
    for number in numbers:
        os.dup2(source, number)
    os.close(source)


@contextmanager
def _environment() -> Iterator[None]:
    before = dict(os.environ)
    os.environ.update(environment())
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)


def environment() -> dict[str, str]:
    """One thread each, since several processes share the cores, and the same packages as here."""
    variables = dict.fromkeys(THREADS, "1") | dict(os.environ)
    if (ROOT / "pyproject.toml").exists():  # a source tree, which need not be installed
        paths = [variables.get("PYTHONPATH", ""), str(ROOT)]
        variables["PYTHONPATH"] = os.pathsep.join(path for path in paths if path)
    # SPT_NOENV: /proc tells the environment of children, for which their titles are cut.
    return variables | {"PYTHONUNBUFFERED": "1", SAFE_PATH: "1", "SPT_NOENV": "1"}
