"""The common style of figures: colours, fonts, axes, files.

matplotlib is an optional dependency, imported when a figure is drawn.
"""

import importlib.util
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from clod_adapter._support.version import package_version
from clod_adapter.errors import ClodError
from clod_adapter.io.atomic import atomic_path

INK, QUIET, GRID, PAPER = "#1c1c1e", "#6b6b70", "#e4e4e7", "#ffffff"
BLUE, ORANGE, GREEN, PURPLE = "#1f5fa8", "#c2571a", "#2d7d5a", "#7a4fa3"
SERIES = (BLUE, ORANGE, GREEN, PURPLE, QUIET)  # in the order that lines are drawn
DPI = 200
STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",  # included in matplotlib, so text has the same size everywhere
    "text.color": INK,
    "axes.edgecolor": QUIET,
    "axes.labelcolor": INK,
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": GRID,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "xtick.color": QUIET,
    "ytick.color": QUIET,
    "font.size": 9,
    "text.parse_math": False,  # names of files may have a $
    "svg.fonttype": "none",  # keeps text as text in a page
}


def check_matplotlib() -> None:
    """Raises ClodError if matplotlib is missing, for a check before long work."""
    if importlib.util.find_spec("matplotlib") is None:
        raise ClodError("pictures need matplotlib: pip install matplotlib")


@contextmanager
def new_figure(inches: tuple[float, float], **options: Any) -> Iterator[Any]:
    """A matplotlib figure in the common style; without pyplot, so a notebook's figures are not affected."""
    check_matplotlib()
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context(STYLE):
        yield Figure(figsize=inches, dpi=DPI, facecolor=PAPER, **options)


def save_figure(figure: Any, path: str | Path) -> None:
    # Text in a PNG by which a later run recognizes its own output.
    about = {"Software": f"clod-adapter {package_version()}"} if Path(path).suffix.lower() == ".png" else None
    with atomic_path(path) as part:
        figure.savefig(part, facecolor=PAPER, metadata=about)


def label_log(axis: Any, text: str = "{:,.0f}", subs: Sequence[float] = (1, 2, 5)) -> None:
    """Labels at round numbers of a log axis, ``subs`` in each decade, written out."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axis.set_major_locator(LogLocator(subs=subs))
    axis.set_major_formatter(FuncFormatter(lambda value, _: text.format(value)))
    axis.set_minor_formatter(NullFormatter())
