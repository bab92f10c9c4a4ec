"""The command tangram-studio."""

from conf.cli import entry, tell
from conf.commands import Plain


def studio() -> int:
    """Serve the studio's page; returns the exit status of tangram-studio."""
    return entry("studio", _studio)


def _studio(settings: Plain) -> int:
    from importlib.util import find_spec

    from tangram_core.errors import ConfigError
    from tangram_core.setup import from_mapping
    from tangram_studio.config import StudioConfig

    config = from_mapping(StudioConfig, settings)
    missing = [name for name in ("starlette", "uvicorn", "websockets") if find_spec(name) is None]
    if missing:
        raise ConfigError(
            f"tangram-studio needs {', '.join(missing)}: in a clone run make studio, or "
            "pip install -c constraints.txt '.[studio]'"
        )
    tell("loading the agents")

    from tangram_studio.server import serve

    return serve(config)
