"""Code of the user's own on a command line: loaded here, and nowhere else.

A task or an agent that no preset names, from a file or from another package, is written for hydra
as its kind: agent=td3.py:TD3 as agent.kind=td3.py:TD3.
"""

from collections.abc import Sequence

from conf.help import choices
from tangram_core.errors import ConfigError
from tangram_core.registry import KIND, Role, announced, load_own
from tangram_core.run.code import MODULES, name_modules, own_code, unquoted

ROLES: tuple[Role, ...] = ("task", "agent")


def with_named_code(arguments: Sequence[str], *, composes: bool) -> list[str]:
    """Load the code that arguments name, and write them as hydra takes them.

    Args:
        arguments: of a command.
        composes: whether it makes a task and an agent of them. What plays a trained run has them
            already, and only learns which of their code is trusted.

    Raises:
        ConfigError: code that cannot be loaded.
    """
    given = [_named(argument) for argument in arguments]
    return [argument for argument, is_code in given if composes or not is_code]


def _named(argument: str) -> tuple[str, bool]:
    """An argument for hydra, and whether it is code."""
    name, _, value = argument.lstrip("+").partition("=")
    plain = unquoted(value)
    if name == MODULES:
        name_modules(plain)
        return argument, True
    for role in ROLES:
        if name in (role, f"{role}.{KIND}") and own_code(plain) is not None:
            if "," in plain:
                raise ConfigError(f"{argument}: one file at a time: give a sweep for each")
            load_own(role, plain)
            return f"{role}.{KIND}={value}", True
        if name == role and plain not in choices(role) and plain in announced(role):
            return f"{role}.{KIND}={value}", False
    return argument, False
