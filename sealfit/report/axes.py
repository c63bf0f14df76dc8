"""What several plots share: axes that read well, one scale for all panels, the order of names."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter, NullLocator

from sealfit.report.symbols import plain, short

MOST_TICKS = 6  # names of categories that fit below a panel
TICK_APART = 0.11  # of the axis: closer ticks would write over each other


def is_logarithmic(x: np.ndarray, span: float) -> bool:
    """Return whether values that span more than a factor lie more evenly on a logarithmic axis than on a linear one."""
    x = np.unique(x[np.isfinite(x)])
    if len(x) < 3 or x[0] <= 0 or x[-1] / x[0] <= span:
        return False
    gap, log_gap = np.diff(x).max() / np.ptp(x), np.diff(np.log(x)).max() / np.ptp(np.log(x))
    return bool(log_gap < 1.5 * gap)  # speeds and times are usually chosen by factors


def value_ticks(ax: Axes, x: np.ndarray) -> None:
    """Put the ticks at the values themselves where they are few and far enough apart, else at round numbers."""
    x = np.unique(x)
    if 1 < len(x) <= MOST_TICKS and np.diff(x).min() > TICK_APART * np.ptp(x):
        ax.set_xticks(x, [f"{value:.4g}".replace("-", "−") for value in x])
    else:
        ax.xaxis.set_major_locator(round_ticks(integer=bool(np.array_equal(x, np.round(x)))))


def round_ticks(*, integer: bool = False) -> MaxNLocator:
    """Return a locator of round numbers, few enough for their labels to stand side by side."""
    return MaxNLocator(5, steps=[1, 2, 5, 10], integer=integer)


def log_axis(ax: Axes) -> None:
    """Make the x axis logarithmic, with ticks at 1, 2 and 5 written as plain numbers."""
    ax.set_xscale("log")
    low, high = ax.get_xlim()
    subs = (1.0, 2.0, 5.0) if np.log10(high / low) < 2.8 else (1.0,)
    ax.xaxis.set_major_locator(LogLocator(subs=subs, numticks=20))
    ax.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    ax.xaxis.set_minor_locator(NullLocator() if len(subs) > 1 else LogLocator(subs=(2.0, 5.0), numticks=40))
    ax.xaxis.set_minor_formatter(NullFormatter())


def category_ticks(ax: Axes, labels: Sequence[str]) -> None:
    """Name categories below the axis, each that fits; cut long names, skip evenly where there are many."""
    every = int(np.ceil(len(labels) / MOST_TICKS))
    shown = list(range(0, len(labels), every))
    room = max(4, int(42 / max(len(shown), 1)))
    ax.set_xticks(shown, [plain(short(labels[k], room)) for k in shown])
    ax.set_xlim(-0.6, len(labels) - 0.4)
    ax.grid(axis="x", visible=False)


def padded(low: float, high: float) -> tuple[float, float]:
    """Return the ends of a scale that holds both values with a little room."""
    room = 0.06 * (high - low) or 0.05 * abs(high) or 1.0
    return float(low - room), float(high + room)


def is_number(text: str) -> bool:
    """Return whether text is a number."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def in_order(values: Iterable[str], key: Callable[[str], str] = str) -> list[str]:
    """Return texts in order, those that are numbers by their size and before the others."""
    return sorted(
        values, key=lambda value: (0, float(key(value)), "") if is_number(key(value)) else (1, 0.0, key(value))
    )


def natural(entry: tuple[str, object]) -> list[tuple[int, float, str]]:
    """Return a sort key that puts 9 before 10."""
    return [(0, float(word), "") if is_number(word) else (1, 0.0, word) for word in entry[0].split()]


def capital(text: str) -> str:
    """Return text with its first letter large."""
    return text[:1].upper() + text[1:]


def evenly(count: int, wanted: int) -> list[int]:
    """Return `wanted` places of `count`, spread evenly from the first to the last; some twice where there are fewer."""
    return [round(k * (count - 1) / max(wanted - 1, 1)) for k in range(wanted)]
