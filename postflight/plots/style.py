"""How does every figure of the project look? Colours by meaning, axes, bands, legends, the corner's note, the file.

A figure function is wrapped by `in_style`, which sets matplotlib's parameters while it draws, leaves those of the
caller as they are, and takes no text as TeX: a name from a file is drawn as it stands. Colours are asked for by what
they mean (``COLOUR["truth"]``), never by value: the eight of Okabe and Ito, which stay apart for colour-blind readers,
with strokes that stay apart in grey. The report's page takes its colours from the same tables, so this module imports
matplotlib only when something is drawn.

A shaded band is one standard deviation to both sides unless its label gives another size.

References
----------
M. Okabe, K. Ito, *Color Universal Design*, 2008.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, ParamSpec, TypeVar

import numpy as np

from flightmodel.checks import FloatArray, GateError
from flightmodel.deflection import HOLE_FACTOR

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_BLACK, _BLUE, _VERMILION, _GREEN = "#000000", "#0072B2", "#D55E00", "#009E73"
_PURPLE, _ORANGE, _SKY, _YELLOW = "#CC79A7", "#E69F00", "#56B4E9", "#F0E442"
_INK, _DARK, _GREY, _PALE, _WHITE = "#1C2126", "#57616B", "#8A929A", "#DDE2E7", "#FFFFFF"

COLOUR = {
    # deflection by method
    "camera": _BLUE,
    "misalignment": _VERMILION,
    "trim": _GREEN,
    "fused": _PURPLE,
    "truth": _BLACK,
    # a quantity and what it is compared with
    "measured": _BLACK,
    "estimate": _BLUE,
    "corrected": _GREEN,
    "second": _VERMILION,
    "nominal": _ORANGE,
    "ground": _SKY,
    "paper": _BLACK,
    "filter": _VERMILION,
    "smoother": _BLUE,
    # what was known before
    "prior": _GREY,
    "prior_band": _PALE,
    # marks
    "edited": _VERMILION,
    "limit": _DARK,
    "zero": _DARK,
    "flagged": _ORANGE,
    "edge": _YELLOW,
    "note": _DARK,
    "gap": _WHITE,
}
AXES = {"x": _BLUE, "y": _VERMILION, "z": _GREEN}
RAW_AXES = {"x": _GREY, "y": "#E5A06B", "z": "#7FC4AD"}  # of the samples as measured: the same hues, paler
ZONE = {"stable": ("#D6EAD9", "#2F7D3B"), "unstable": ("#F9E3BD", "#B36B00"), "divergent": ("#F1C3BD", "#A3201A")}
# for many lines side by side, the reference first, each with its stroke
MANY = (_BLACK, _BLUE, _ORANGE, _GREEN, _PURPLE, _SKY, _VERMILION)
STROKES: tuple[Any, ...] = ((0, (4, 2)), "-", "-", (0, (5, 1)), "-", (0, (1, 1)), (0, (3, 1, 1, 1)))
# the report's page: text, background, lines; each is a variable of its CSS
PAGE = {
    "ink": _INK, "soft": _DARK, "line": _PALE, "ground": _WHITE, "pale": "#F5F7F9", "answer": "#F2F7FB",
    "behind": "#E9EEF3", "grid": "#ECEFF2", "tick": "#C4CCD3", "border": "#B9C2CA", "accent": "#005A8C",
    "good": "#00674C", "bad": "#A33C00",
}  # fmt: skip
# over a frame at the bench: points that a fit uses, that it rejects, the edge predicted, marks by hand
OVER_FRAME = {"used": _GREEN, "left": _VERMILION, "outline": _YELLOW, "marks": _SKY}

LABEL = {
    "camera": "video (virtual camera)", "misalignment": "accelerometers (misalignment)", "trim": "trim angle",
    "fused": "all fused",
}  # fmt: skip
STROKE = {"camera": "-", "misalignment": "--", "trim": "-.", "fused": "-"}
TIME = "time after launch (s)"
BAND, WIDE_BAND = 0.2, 0.15  # opacities: of one band, and of several that overlap
_PARAMETERS: dict[Any, Any] = {
    "figure.constrained_layout.use": True, "figure.titlesize": 10, "font.size": 9.5, "lines.linewidth": 1.2,
    "axes.titlesize": 9, "axes.labelsize": 9, "axes.grid": True, "axes.axisbelow": True, "grid.alpha": 0.3,
    "axes.spines.top": False, "axes.spines.right": False, "xtick.labelsize": 8.5, "ytick.labelsize": 8.5,
    "legend.frameon": False, "legend.fontsize": 8, "legend.title_fontsize": 8, "legend.loc": "upper left",
}  # fmt: skip
# formats of figures, and what matplotlib would write into each that differs from day to day or place to place
FORMATS = {"png": "Software", "pdf": "CreationDate", "svg": "Date"}
_P = ParamSpec("_P")
_R = TypeVar("_R")


def in_style(draw: Callable[_P, _R]) -> Callable[_P, _R]:
    """Let a figure function draw with the project's parameters; the caller's own stay as they are."""

    @wraps(draw)
    def styled(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        import matplotlib
        from matplotlib.figure import Figure

        with matplotlib.rc_context(_PARAMETERS):
            drawn = draw(*args, **kwargs)
            if isinstance(drawn, Figure):
                _without_tex(drawn)
            return drawn

    return styled


def _without_tex(figure: Figure) -> None:
    """Draw all texts literally except the tick labels, since a logarithmic axis writes these as TeX."""
    from matplotlib.axis import Axis
    from matplotlib.text import Text

    artists: list[Artist] = [figure]
    while artists:
        artist = artists.pop()
        if isinstance(artist, Axis):  # whose children are made by looking at them
            artists += [artist.label, artist.offsetText]
            continue
        if isinstance(artist, Text):
            artist.set_parse_math(False)
        artists += artist.get_children()


def band(
    ax: Axes, x: FloatArray, middle: FloatArray, sd: FloatArray, colour: str, *, alpha: float = BAND, label: str = ""
) -> None:
    """Shade one standard deviation to both sides of a curve (n,)."""
    ax.fill_between(x, middle - sd, middle + sd, color=colour, alpha=alpha, lw=0, label=label or None)


def legend_above(ax: Axes, ncols: int, title: str | None = None) -> None:
    """Place the legend between the axes and what is above them, off the data."""
    ax.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=ncols, borderaxespad=0.0, title=title)


def with_holes(time_s: FloatArray, columns: Iterable[FloatArray]) -> tuple[FloatArray, list[FloatArray]]:
    """Insert NaN into every hole of a history, so that no line is drawn across; see `DeflectionHistory` for holes."""
    import pandas as pd  # the strokes and colours alone need none

    columns = list(columns)
    if len(time_s) < 2:
        return time_s, columns
    step = np.diff(time_s)
    # by the steps around: a history may have two rates
    usual = pd.Series(step).rolling(9, center=True, min_periods=1).median().to_numpy()
    at = np.flatnonzero(step > HOLE_FACTOR * usual) + 1
    middle = 0.5 * (time_s[at - 1] + time_s[at])
    return np.insert(time_s, at, middle), [np.insert(c, at, np.nan) for c in columns]


def percentiles(ax: Axes, time_s: FloatArray, low: FloatArray, middle: FloatArray, high: FloatArray) -> None:
    """Draw the 2.3, 50 and 97.7 percentiles of many flights over time."""
    ax.fill_between(time_s, low, high, color=COLOUR["estimate"], alpha=BAND, lw=0, label="2.3 to 97.7 %")
    ax.plot(time_s, middle, color=COLOUR["estimate"], label="50 %")


def limits(ax: Axes, *, vertical: bool = False) -> None:
    """Draw the dotted lines that a ratio to its standard deviation should stay between."""
    for level in (-3.0, 3.0):
        (ax.axvline if vertical else ax.axhline)(level, color=COLOUR["limit"], lw=0.8, ls=":")


def ellipses(ax: Axes, mean: FloatArray, covariance: FloatArray) -> None:
    """Draw the ellipses of one and two standard deviations of two quantities: mean (2,), covariance (2, 2)."""
    turn = np.linspace(0.0, 2.0 * np.pi, 200)
    circle = np.linalg.cholesky(covariance) @ np.stack([np.cos(turn), np.sin(turn)])
    for size, stroke in ((1.0, "-"), (2.0, "--")):
        ax.plot(*(mean[:, None] + size * circle), color=COLOUR["estimate"], ls=stroke, label=f"{size:g} sd")


_DRAWN = {
    "rad": (1e3, "mrad"), "deg": (1e3 * np.pi / 180.0, "mrad"), "T": (1e6, "uT"),
    "rad/s": (1e3, "mrad/s"), "deg/s": (1e3 * np.pi / 180.0, "mrad/s"),
}  # fmt: skip


def drawn_unit(unit: str) -> tuple[float, str]:
    """Scale and unit in which residuals of a unit are drawn."""
    return _DRAWN.get(unit, (1.0, unit))


def note(figure: Figure, words: str) -> None:
    """Write the flight's description in the lower right corner."""
    figure.supxlabel(words, x=0.995, ha="right", fontsize=7, color=COLOUR["note"], parse_math=False)


def flight_words(name: str, synthetic: bool, changes: tuple[str, ...] = ()) -> str:
    """Words for the corner: the flight, whether it is synthetic, and what a what-if assumes."""
    assumed = f"; what-if: {'; '.join(changes)}" if changes else ""
    return f"{name}: {'SYNTHETIC flight' if synthetic else 'flight'}{assumed}"


def titled(figure: Figure, title: str, words: str) -> Figure:
    """Figure with its title, and the flight's description in its corner."""
    figure.suptitle(title)
    note(figure, words)
    return figure


def save(figure: Figure, path: str | Path | IO[bytes]) -> None:
    """Write a figure as PNG, PDF or SVG; the bytes depend on the picture alone.

    Parameters
    ----------
    figure : Figure
    path : path or binary file
        Its ending says the format; a binary file, such as a `io.BytesIO`, becomes a PNG.

    Raises
    ------
    GateError
        For another ending.
    """
    import matplotlib

    form = Path(path).suffix.lower().removeprefix(".") if isinstance(path, str | Path) else "png"
    if form not in FORMATS:
        raise GateError(f"{path}: a figure is saved as {', '.join(FORMATS)}", "option-format")
    figure.set_dpi(110)
    # `savefig` draws a figure with a layout once more in vain to lay it out
    layout = figure.get_layout_engine()
    if layout is not None:
        layout.execute(figure)
        figure.set_layout_engine("none")
    # no date, and in SVG no random names
    with matplotlib.rc_context({"svg.hashsalt": "postflight"}):
        figure.savefig(path, format=form, dpi="figure", metadata={FORMATS[form]: None})


class FigureWarning(RuntimeWarning):
    """Warning that a figure was not drawn, and why; all other results of the run are unaffected."""

    code = "figure-failed"


def draw(path: Path, figure: Callable[_P, Figure], *args: _P.args, **named: _P.kwargs) -> None:
    """Draw and `save` a figure; a failure affects that figure alone and issues a `FigureWarning`.

    Raises
    ------
    OSError
        Where the file cannot be written: then nothing else can.
    """
    try:
        save(figure(*args, **named), path)
    except OSError:
        raise
    except Exception as fault:
        path.unlink(missing_ok=True)
        words = f"{path.name} was not drawn ({type(fault).__name__}: {fault}); tables and report are whole"
        warnings.warn(FigureWarning(words), stacklevel=2)


@dataclass(frozen=True)
class FigureFolder:
    """Folder of figures, and the formats in which each of them is drawn there."""

    path: Path
    formats: tuple[str, ...] = ("png",)

    def draw(self, name: str, figure: Callable[_P, Figure], *args: _P.args, **named: _P.kwargs) -> None:
        """Draw a figure in every format, each as `draw` does."""
        for form in self.formats:
            draw(self.path / f"{name}.{form}", figure, *args, **named)
