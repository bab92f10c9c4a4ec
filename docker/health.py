"""Health check of a container: the master answers, or the worker can reach its master.

    health.py master|worker [CONNECTION_FILE]

A worker that makes no progress ends itself, so only the connection to its master is checked. Only
the standard library is imported, because this runs every few seconds.
"""

import json
import socket
import sys
import urllib.request
from pathlib import Path
from urllib.parse import urlsplit

RUNS = Path("/runs")
TIMEOUT_S = 4.0


def main() -> str | None:
    """The problem in words; None if the container is healthy."""
    role = sys.argv[1]
    files = [Path(name) for name in sys.argv[2:]] or list(RUNS.glob("*/connection.json"))
    if not files:
        return "no connection file: no master runs"
    try:
        content = json.loads(max(files, key=lambda path: path.stat().st_mtime).read_text())
        if role == "master":
            port = urlsplit(content["http"]).port
            urllib.request.urlopen(f"http://127.0.0.1:{port}/healthz", None, TIMEOUT_S).close()
        else:
            place = urlsplit(content["endpoint"])
            if place.scheme == "ipc":
                with socket.socket(socket.AF_UNIX) as end:
                    end.settimeout(TIMEOUT_S)
                    end.connect(place.path)
            else:
                socket.create_connection((place.hostname, place.port), TIMEOUT_S).close()
    except OSError as error:  # also what urllib raises for HTTP errors such as 503
        return str(error)
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        return f"no connection file of a run ({error!r})"
    return None


if __name__ == "__main__":
    sys.exit(main())  # a text goes to stderr, with status 1
