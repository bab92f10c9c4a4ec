"""The command tangram-studio."""

from conf.cli import entry, tell
from conf.commands import Plain


def studio() -> int:
    """tangram-studio: a page to play on."""
    return entry("studio", _studio)


def _studio(settings: Plain) -> int:
    from importlib.util import find_spec

    from tangram_agent.setup import from_mapping
    from tangram_core.errors import ConfigError
    from tangram_studio.config import StudioConfig

    config = from_mapping(StudioConfig, settings)
    missing = [name for name in ("starlette", "uvicorn", "websockets") if find_spec(name) is None]
    if missing:
        raise ConfigError(
            f"tangram-studio needs {', '.join(missing)}: in a clone type make studio, or "
            "pip install -c constraints.txt '.[studio]'"
        )
    tell("loads the agents")

    from tangram_studio.server import serve

    return serve(config)
