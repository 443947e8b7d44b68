"""A check of ``clod-adapt doctor``: a function that runs one thing, and its result."""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable
from contextlib import redirect_stdout
from dataclasses import dataclass

from clod_adapter._support.text import first_line

from ..shared.console import WIDTH

Probe = Callable[[], str]
"""Runs one thing and returns a line about it; raises CheckFailed, or any other error, where it does not work."""


class CheckFailed(Exception):
    """Something does not work on this machine.

    Args:
        found: the reason, in a few words.
        fix: the command to type, or what to do.
    """

    def __init__(self, found: str, fix: str) -> None:
        super().__init__(found)
        self.found, self.fix = found, fix


@dataclass(frozen=True)
class Check:
    """The result of one check.

    Attributes:
        name: of the thing checked.
        ok: whether it works.
        found: version or measurement, or the reason why it does not work.
        fix: the command that fixes it; empty where it works, or no fix is known.
    """

    name: str
    ok: bool
    found: str
    fix: str = ""

    @classmethod
    def run(cls, name: str, probe: Probe) -> Check:
        """Runs a probe. Any error is a result, since the code checked belongs to other projects."""
        try:
            with warnings.catch_warnings(), redirect_stdout(io.StringIO()):  # gsplat prints, torch warns
                warnings.simplefilter("ignore")
                return cls(name, True, probe())
        except CheckFailed as failed:
            return cls(name, False, failed.found, failed.fix)
        except Exception as error:
            if isinstance(error.__cause__, KeyboardInterrupt):  # within the dispatching of a compiled function
                raise
            return cls(name, False, f"failed with {type(error).__name__}: {first_line(error)}")

    def line(self, width: int) -> str:
        """``name  ok/off  found  -> fix``; the name takes ``width`` characters. A long line has the fix below it."""
        line, fix = f"{self.name:<{width}}{'ok' if self.ok else 'off':<5}{self.found}", f"-> {self.fix}"
        if not self.fix:
            return line
        beside = f"{line}  {fix}"
        return beside if len(beside) <= WIDTH else f"{line}\n    {fix}"
