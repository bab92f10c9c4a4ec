"""Reading settings from files of strangers: the size is checked before the YAML is built."""

from typing import Any

import yaml

from tangram_core.errors import ConfigError

CONFIG = "config.yaml"  # in a run's folder
MAX_TEXT = 100_000  # characters; a run's config.yaml has some 3,000
MAX_VALUES = 10_000
MAX_DEPTH = 20


def load_settings(text: str, source: str) -> Any:
    """The content of a YAML text; ConfigError if it is not valid or too large."""
    try:
        check_extent(text, source)
        return yaml.safe_load(text)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        why = " ".join(str(error).split()) or type(error).__name__
        raise ConfigError(f"{source} is not valid YAML ({why}): correct it") from None


def check_extent(text: str, source: str) -> None:
    """Raise ConfigError if a YAML text is too large; values that aliases repeat are counted."""
    large = len(text) > MAX_TEXT
    total, sizes, begun = 0, dict[str | None, int](), list[tuple[str | None, int]]()
    for event in () if large else yaml.parse(text, yaml.SafeLoader):
        if isinstance(event, yaml.AliasEvent):
            # An alias inside the value that it repeats has no end.
            total += sizes.get(event.anchor, MAX_VALUES)
        elif isinstance(event, yaml.CollectionStartEvent):
            begun.append((event.anchor, total))
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, before = begun.pop()
            total += 1
            sizes[anchor] = total - before
        elif isinstance(event, yaml.ScalarEvent):
            total += 1
            sizes[event.anchor] = 1
        if total > MAX_VALUES or len(begun) > MAX_DEPTH:
            large = True
            break
    if large:
        raise ConfigError(
            f"{source} is too large for settings: it must have at most {MAX_TEXT} characters, "
            f"{MAX_VALUES} values with what aliases repeat, and {MAX_DEPTH} levels: shorten it"
        )
