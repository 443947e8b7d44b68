"""What files say about the screen-space filter that their Gaussians were trained with.

Ours say it in full, where it is not the usual one: in the header of a PLY as ``clod_adapter screen_filter 0.3 True``
(the variance in px^2, and whether opacities are compensated), elsewhere in the description (``card``). Other programs
say at most that there was antialiasing: Brush and splat-transform by the comment ``SplatRenderMode: mip``, Postshot by
``antialiased 1``, SPZ by a flag, Mip-Splatting by the column ``filter_3D``.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from typing import Any

from clod_adapter.config import CLASSIC, FILTERS, ScreenFilter

KEY = "screen_filter"
TAG = "SplatRenderMode: mip"
_ANTIALIASED = r"(?i)\s*(splatrendermode:\s*mip|antialiased 1)\s*"
_EITHER = r"(?i)\s*(splatrendermode:\s*\S*|antialiased [01])\s*"
_BRUSH = "Exported from Brush"


def is_antialiased(comments: Iterable[str]) -> bool:
    """Whether a comment of another program says that opacities are compensated."""
    return any(re.fullmatch(_ANTIALIASED, comment) for comment in comments)


def tagged(comments: Sequence[str], screen_filter: ScreenFilter) -> list[str]:
    """The comments with those that other programs look for made true; the same where they are true already."""
    if is_antialiased(comments) == screen_filter.compensate:
        return list(comments)
    rest = [comment for comment in comments if not re.fullmatch(_EITHER, comment)]
    return [*rest, TAG] if screen_filter.compensate else rest


def words_of(screen_filter: ScreenFilter) -> list[str]:
    """Comments of ours, without their prefix: none for the usual filter, which files do not mention."""
    if screen_filter == CLASSIC:
        return []
    return [f"{KEY} {screen_filter.variance} {screen_filter.compensate}"]


def parse_words(words: str) -> ScreenFilter:
    """The filter of the words behind ``KEY``.

    Raises:
        ValueError, ClodError: they say none.
    """
    variance, compensate = words.split()
    if compensate not in ("True", "False"):
        raise ValueError(f"{KEY} {words} ends neither in True nor in False")
    return ScreenFilter(variance=float(variance), compensate=compensate == "True")


def entry_of(screen_filter: ScreenFilter) -> dict[str, Any]:
    """What a JSON description says of it: nothing of the usual one."""
    return {} if screen_filter == CLASSIC else {KEY: asdict(screen_filter)}


def parse_entry(values: dict[str, Any]) -> ScreenFilter:
    """The filter of a JSON description; the usual one where it is silent.

    Raises:
        AttributeError, KeyError, TypeError, ValueError, ClodError: what it says is none.
    """
    if KEY not in values:
        return CLASSIC
    return ScreenFilter(variance=float(values[KEY]["variance"]), compensate=values[KEY]["compensate"])


def likely(comments: Sequence[str], columns: Iterable[str]) -> ScreenFilter:
    """The filter that other programs' comments and columns speak for, the usual one where none does.

    Args:
        columns: names of the vertices' properties, as in the file.
    """
    if "filter_3D" in columns or (is_antialiased(comments) and _BRUSH in comments):
        return FILTERS["mip"]
    return FILTERS["on"] if is_antialiased(comments) else CLASSIC
