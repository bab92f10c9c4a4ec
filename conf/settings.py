"""`python -m conf.settings` writes docs/settings.md from the declarations of all settings."""

from collections.abc import Iterator
from dataclasses import Field
from importlib.resources import files
from pathlib import Path
from typing import Any

import yaml

from conf.commands import COMMANDS, GROUPS, Command, declared, load, plain_default
from conf.help import choices, playable, told_default
from conf.kinds import Kinds, every_kind
from tangram_core.settings import KEY, Declaration, declared_fields, told, values_of

PAGE = Path(__file__).parents[1] / "docs" / "settings.md"
# Lists of settings inside of a setting.
NESTED = {"agent.hindsight": "tangram_agent.base.config:RelabelConfig"}
INTRODUCTION = """\
# Settings

Written by `python -m conf.settings` from the declarations in the code; a test checks that it is up
to date. Give a setting as `name=value`, a preset of a group as `group=preset`. `null` means no
value; `???` means that a value must be given. A value that has no effect with the other settings is
refused.

Put presets of your own into a folder, as in `my_presets/tokens/mine.yaml`. They set only what
differs from the defaults. Use them with `tangram-train --config-dir my_presets tokens=mine`."""


def page() -> str:
    """The text of docs/settings.md."""
    parts, told = [INTRODUCTION], dict[str, str]()  # row -> first command with this row
    for command in COMMANDS.values():
        rows = [_row(own, own.name, command.defaults()[own.name]) for own in command.fields()]
        groups = ", ".join(command.groups)
        taken = [f"Groups: {groups}."] if groups else []
        parts += [f"## {command.name}", *taken, *_laid_over(command), *_as_above(rows, told)]
        new = [row for row in rows if row not in told]
        parts += [_table(new)] if new else []
        told |= dict.fromkeys(new, command.name)
    for group in GROUPS:
        parts += [f"## {group}", _presets(group)]
        known = set[str]()
        for kinds in every_kind(group):
            rows = [
                _row(own, f"{group}.{own.name}", plain_default(own)) for own in _own(group, kinds)
            ]
            new, shared = [row for row in rows if row not in known], known & set(rows)
            parts += [*_of_kind(group, kinds, shared), *([_table(new)] if new else [])]
            known |= set(rows)
    for group, name in NESTED.items():
        rows = [
            _row(own, f"{group}.{own.name}", plain_default(own))
            for own in declared_fields(load(name))
        ]
        parts += [f"## Entries of {group}", _table(rows)]
    return "\n\n".join(parts) + "\n"


def _as_above(rows: list[str], told: dict[str, str]) -> Iterator[str]:
    """Lines with the settings that a command shares with earlier commands."""
    for first in dict.fromkeys(told.values()):
        names = [row.split("|")[1].strip() for row in rows if told.get(row) == first]
        if names:
            yield f"As for `{first}`: {', '.join(names)}."


def _laid_over(command: Command) -> Iterator[str]:
    """A line with the settings of a run that a command can replace."""
    if command.over:
        names = ", ".join(f"`{name}`" for group in command.over for name in playable(group))
        yield (
            "These settings can replace those of the run, as in `agent.reapply=1`: "
            f"{names}. Other settings of {', '.join(command.over)} are refused."
        )


def _own(group: str, kinds: Kinds) -> list["Field[Any]"]:
    return declared(kinds.sections()[group])


def _of_kind(group: str, kinds: Kinds, shared: set[str]) -> Iterator[str]:
    """The heading of a kind's settings, if the group has several kinds."""
    kind = kinds.named().get(group)
    if kind is not None and _own(group, kinds):
        names = sorted(row.split("|")[1].strip() for row in shared)
        yield f"For `{group}.kind={kind}`" + (
            f", besides {', '.join(names)} as above:" if names else ":"
        )


def _table(rows: list[str]) -> str:
    return "\n".join(["| setting | default | values | meaning |", "|---|---|---|---|", *rows])


def _row(own: "Field[Any]", name: str, default: Any) -> str:
    what: Declaration = own.metadata[KEY]
    text = told_default(default) or '""'
    said = f"{what.help}{_only(own.metadata[KEY], name)}".replace("|", "\\|")
    return f"| `{name}` | `{text}` | {_values(own, what)} | {said} |"


def _values(own: "Field[Any]", what: Declaration) -> str:
    if what.choices:
        return ", ".join(what.choices)
    unit = f" {what.unit}" if what.unit else ""
    if what.low is None:
        return "true, false" if isinstance(own.default, bool) else unit.strip()
    if what.high < float("inf"):
        return f"{what.low:g} to {what.high:g}{unit}"
    return f"from {what.low:g}{unit}"


def _only(what: Declaration, name: str) -> str:
    section = name.rpartition(".")[0]
    before = f"{section}." if section else ""
    conditions = [
        *(("only with", before + other, values_of(v)) for other, v in what.only.items()),
        *(("not with", before + other, values_of(v)) for other, v in what.unless.items()),
    ]
    return "".join(f" ({_condition(*one)})" for one in conditions)


def _condition(word: str, other: str, values: tuple[object, ...]) -> str:
    if values == (None,):  # with no value: the other setting is not given
        return f"{'not' if word == 'only with' else 'only'} with {other}"
    return f"{word} {other}={' or '.join(map(told, values))}"


def _presets(group: str) -> str:
    return "\n".join(_preset(group))


def _preset(group: str) -> Iterator[str]:
    for name in choices(group):
        text = (files("conf") / group / f"{name}.yaml").read_text("utf-8")
        about = next(line for line in text.splitlines() if not line.startswith("# @"))
        changed = [key for key in yaml.safe_load(text) or {} if key != "defaults"]
        yield f"- `{group}={name}`: {about.removeprefix('# ')}{_sets(changed)}"


def _sets(names: list[str]) -> str:
    return f" Sets {', '.join(names)}." if names else ""


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
