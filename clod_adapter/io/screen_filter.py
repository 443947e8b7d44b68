"""The screen-space filter as other programs state it.

Brush and splat-transform write the comment ``SplatRenderMode: mip``, Postshot ``antialiased 1``, SPZ a flag,
Mip-Splatting the column ``filter_3D``. None of them states the variance. Files of this package do (``settings``).
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

from clod_adapter.config import CLASSIC, FILTERS, ScreenFilter

TAG = "SplatRenderMode: mip"
_ANTIALIASED = r"(?i)\s*(splatrendermode:\s*mip|antialiased 1)\s*"
_EITHER = r"(?i)\s*(splatrendermode:\s*\S*|antialiased [01])\s*"
_BRUSH = "Exported from Brush"


def is_antialiased(comments: Iterable[str]) -> bool:
    """Whether a comment of another program states that opacities are compensated."""
    return any(re.fullmatch(_ANTIALIASED, comment) for comment in comments)


def tagged(comments: Sequence[str], screen_filter: ScreenFilter) -> list[str]:
    """The comments, with those of other programs corrected where they contradict ``screen_filter``."""
    if is_antialiased(comments) == screen_filter.compensate:
        return list(comments)
    rest = [comment for comment in comments if not re.fullmatch(_EITHER, comment)]
    return [*rest, TAG] if screen_filter.compensate else rest


def implied_filter(comments: Sequence[str], columns: Iterable[str]) -> ScreenFilter:
    """The filter implied by other programs' comments and by the names of the columns; else the classic one."""
    if "filter_3D" in columns or (is_antialiased(comments) and _BRUSH in comments):
        return FILTERS["mip"]
    return FILTERS["on"] if is_antialiased(comments) else CLASSIC
