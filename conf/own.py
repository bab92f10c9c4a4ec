"""The user's own code on a command line, which is loaded only here.

A task or an agent from a file or from another package has no preset. So it is passed to hydra as
its kind: agent=td3.py:TD3 becomes agent.kind=td3.py:TD3.
"""

from collections.abc import Sequence

from conf.help import choices
from tangram_core.errors import ConfigError
from tangram_core.registry import Role, announced, load_own
from tangram_core.run.code import KIND, name_modules, names_modules, own_code, unquoted

ROLES: tuple[Role, ...] = ("task", "agent")


def with_named_code(arguments: Sequence[str]) -> list[str]:
    """Load the code that arguments name; return the arguments for hydra.

    Raises:
        ConfigError: the code cannot be loaded.
    """
    return [_named(argument) for argument in arguments]


def without_named_code(arguments: Sequence[str]) -> list[str]:
    """Drop arguments that name code, for commands that play a run with its task and agent."""
    kinds = {f"{role}.{KIND}": role for role in ROLES}

    def brought(argument: str) -> bool:
        name, _, value = argument.lstrip("+").partition("=")
        plain, role = unquoted(value), kinds.get(name)
        own = role is not None and (own_code(plain) is not None or plain in announced(role))
        return own or names_modules(name)

    return [one for one in arguments if not brought(one)]


def _named(argument: str) -> str:
    name, _, value = argument.lstrip("+").partition("=")
    plain = unquoted(value)
    if names_modules(name):
        name_modules(plain)
    for role in ROLES:
        if name in (role, f"{role}.{KIND}") and own_code(plain) is not None:
            if "," in plain:
                raise ConfigError(f"{argument}: name one file at a time: start a sweep for each")
            load_own(role, plain)
            return f"{role}.{KIND}={value}"
        if name == role and plain not in choices(role) and plain in announced(role):
            return f"{role}.{KIND}={value}"
        if name == role and ".py" in plain:
            raise ConfigError(
                f"{argument}: name the class in it, as in {role}=path/to/file.py:Name"
            )
    return argument
