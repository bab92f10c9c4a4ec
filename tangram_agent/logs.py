"""The form of log lines: for people, or as JSON for programs that collect them."""

import logging

from pythonjsonlogger.json import JsonFormatter

FORMATS = ("text", "json")
NO_EVENT = "note"


def formatter(log_format: str, who: str) -> logging.Formatter:
    """How a process writes its lines.

    JSON lines have `time` (ISO 8601, UTC), `level`, `process`, `event`, `message`, and the fields
    of the event, which callers give to the logger as `extra`.

    Args:
        log_format: one of `FORMATS`.
        who: name of the process.
    """
    if log_format == "json":
        return JsonFormatter(
            ("levelname", "message"),
            rename_fields={"levelname": "level"},
            static_fields={"process": who},
            defaults={"event": NO_EVENT},
            timestamp="time",
        )
    return logging.Formatter(f"%(asctime)s {who}: %(message)s", "%H:%M:%S")
