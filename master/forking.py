"""Child processes that start fast: forks of one server process that has already imported torch.

A process without this server takes seconds for its imports and has its own copy of them in memory.
The server is the fork server of `multiprocessing`. It ends after the process that started it and
all children have ended.
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
SAFE_PATH = "PYTHONSAFEPATH"  # so that the server does not import a user's modules by mistake
ROOT = Path(__file__).resolve().parent.parent
# The function that a process runs. It is pickled by name, so it must be at the top of a module.
Body = Callable[[Sequence[str]], int]

_context = multiprocessing.get_context("forkserver")


def run_command(arguments: Sequence[str]) -> int:
    """Run the command tangram-NAME; arguments[0] is NAME, the rest are the command's arguments.

    Returns:
        The exit status.
    """
    name, *rest = arguments
    sys.argv[:] = [f"tangram-{name}", *rest]
    status: int = import_module("tangram_cli.commands").COMMANDS[name]()
    return status


def warm_up() -> None:
    """Start the server if it is not running, and wait until it can fork.

    The server has the environment of this process. Errors are ignored here: `start` raises them.
    """
    with Path(os.devnull).open() as nothing, suppress(TangramError):
        start(run_nothing, ["nothing"], None, 0, nothing.fileno()).join()


def run_nothing(_: Sequence[str]) -> int:
    """Do nothing and return exit status 0."""
    return 0


def start(
    body: Body, arguments: Sequence[str], log: Path | None, nice: int, read_end: int
) -> ForkServerProcess:
    """Start a process in a new session.

    Args:
        body: function that the process runs.
        arguments: of the function; also the title of the process in `ps`.
        log: file to which the output is appended; None for the terminal.
        nice: added to the niceness of the process.
        read_end: file descriptor of the child's end of its lifeline.

    Raises:
        UnavailableError: the server was just killed, or there is no memory for a process now.
        TangramError: the process cannot start.
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
    """Start the server with our environment and with signals blocked.

    A scheduler may signal all processes of a job. The server must survive that. Its forks unblock
    the signals and receive those that came in between.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        # It belongs to the server, and its start unblocks some signals: block them again.
        resource_tracker.ensure_running()
        signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
        with _environment():
            forkserver.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _become(
    body: Body, arguments: Sequence[str], log: Path | None, nice: int, lifeline: Connection
) -> None:
    """Set up the child process, and run its body."""
    # Ctrl-C goes to all processes of a session; here the parent decides when a child ends.
    os.setsid()
    signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
    os.nice(nice)
    # As in a process that was not forked, for plug-ins and for the processes that they start.
    import_module("numpy").random.seed()
    multiprocessing.set_start_method(None, force=True)
    del os.environ[SAFE_PATH]
    _redirect(os.open(os.devnull, os.O_RDONLY), 0)
    if log is not None:
        try:
            output = os.open(log, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o666)
        except OSError:  # the disk cannot be written: run without a log
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
    """Environment of the children: one thread each, as they share the cores, and our packages."""
    variables = dict.fromkeys(THREADS, "1") | dict(os.environ)
    if (ROOT / "pyproject.toml").exists():  # a source tree, which need not be installed
        paths = [variables.get("PYTHONPATH", ""), str(ROOT)]
        variables["PYTHONPATH"] = os.pathsep.join(path for path in paths if path)
    # SPT_NOENV: keeps the environment readable in /proc; long titles are cut for that.
    return variables | {"PYTHONUNBUFFERED": "1", SAFE_PATH: "1", "SPT_NOENV": "1"}
