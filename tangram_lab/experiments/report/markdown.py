"""Pieces of Markdown, and numbers as people read them."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from tangram_lab.experiments.report.numbers import spread

NOTHING = "-"


@dataclass(frozen=True)
class Measure:
    """A quantity of tables and figures.

    Attributes:
        key: in result.json and in the files of tests.
        label: head of a column.
        axis: label of an axis, with its unit.
        pattern: of one number.
        factor: number in the table / number in the file.
    """

    key: str
    label: str
    axis: str
    pattern: str
    factor: float = 1.0

    def show(self, number: float | None) -> str:
        """One number, `-` if there is none."""
        if number is None:
            return NOTHING
        text = self.pattern.format(number * self.factor)
        return text[1:] if text.startswith("-") and not text.strip("-0.°,") else text

    def show_spread(self, values: Mapping[int, float]) -> str:
        """Median (least to most) over the seeds; only the median where that is all."""
        known = spread(values.values())
        if known is None:
            return NOTHING
        least, median, most = map(self.show, (known.least, known.median, known.most))
        return median if least == median == most else f"{median} ({least} to {most})"

    def show_difference(self, ours: Mapping[int, float], theirs: Mapping[int, float]) -> str:
        """Difference of two medians, with its sign."""
        one, other = spread(ours.values()), spread(theirs.values())
        if one is None or other is None:
            return NOTHING
        signed = self.pattern.replace("{:", "{:+", 1)
        return signed.format((one.median - other.median) * self.factor)


REWARD = Measure("mean_reward", "mean reward", "mean reward (\N{MINUS SIGN}1 to 1)", "{:.3f}")
DENSE = Measure(
    "mean_reward_dense",
    "mean dense reward",
    "mean dense reward, Eq. 15 (\N{MINUS SIGN}1 to 1)",
    "{:.3f}",
)
ANGLE = Measure("angle_error_deg_median", "angle error", "angle error, median (degrees)", "{:.2f}°")
POSITION = Measure(
    "position_error_median", "position error", "position error, median (arena units)", "{:.4f}"
)
EPISODES = Measure("episodes", "episodes", "episodes", "{:,.0f}")
UPDATES = Measure("updates", "updates", "updates", "{:,.0f}")
MINUTES = Measure("train_s", "training, min", "training time (minutes)", "{:,.1f}", 1 / 60)
HOURS = Measure("train_s", "training, h", "training time (hours)", "{:,.2f}", 1 / 3600)
PARAMETERS = Measure("parameters", "parameters", "parameters", "{:,.0f}")


def table(head: Sequence[str], rows: Iterable[Sequence[str]], rest: str = "---:") -> list[str]:
    """A table; the columns after the first are numbers, unless `rest` is `---`."""
    ruler = ["---", *[rest] * (len(head) - 1)]
    return [_line(map(_cell, head)), _line(ruler), *(_line(map(_cell, row)) for row in rows), ""]


def details(summary: str, lines: Sequence[str]) -> list[str]:
    """Lines that unfold with a click."""
    return ["<details>", f"<summary>{plain(summary)}</summary>", "", *lines, "</details>", ""]


def shell(command: str) -> list[str]:
    """A command to copy."""
    return ["```bash", command, "```", ""]


def plain(text: str) -> str:
    """A text that shows as it stands, in a line of Markdown."""
    return text.replace("&", "&amp;").replace("<", "&lt;").replace("\n", " ")


def picture(title: str, file: str) -> list[str]:
    """A figure by its relative path."""
    alternative = plain(title).replace("[", "(").replace("]", ")")
    return [f"![{alternative}]({file})", ""]


def _line(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _cell(text: str) -> str:
    return plain(text).replace("|", "\\|")
