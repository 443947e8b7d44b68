"""The command in surroundings and with words that took it down: success, or one line and exit code 2."""

from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import hostile

PARTS = ("--json >&-", "cd gone")


def test_hostile_surroundings(capture: Any) -> None:
    every = (*hostile.streams(), *hostile.folders(), *hostile.options(), *hostile.environments())
    cases = [case for case in every if any(part in case.line for part in PARTS)]
    assert len(cases) >= 2
    with ThreadPoolExecutor(2) as pool:
        found = pool.map(partial(hostile.failures, inputs=Path(capture.ply).parent), cases)
    assert not {case.line: lines for case, lines in zip(cases, found, strict=True) if lines}
