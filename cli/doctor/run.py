"""``clod-adapt doctor``: what works here, why the rest does not, and the line that mends it."""

from __future__ import annotations

import argparse
import time
from typing import Any

from clod_adapter.version import package_version

from ..shared.console import Console
from ..shared.findings import Finding, Look
from .backends import BACKENDS
from .tools import TOOLS

DRAWS = ("cpu", "gpu")  # those that the commands draw and train with
LOOKS: dict[str, Look] = BACKENDS | TOOLS


def run(args: argparse.Namespace) -> dict[str, Any]:
    """Looks at everything; the report's exit code is 1 where nothing draws."""
    console, findings, seconds = Console(args.quiet), list[Finding](), dict[str, float]()
    with console.status("looking ...") as show:
        for name, look in LOOKS.items():
            show(f"looking at {name} ({len(findings) + 1} of {len(LOOKS)}) ...")
            began = time.perf_counter()
            findings.append(Finding.of(name, look))
            seconds[name] = round(time.perf_counter() - began, 3)
    width = max(map(len, LOOKS)) + 2
    draws = [finding.name for finding in findings if finding.ok and finding.name in DRAWS]
    print("\n".join(finding.line(width) for finding in findings))
    print(f"draws and trains on: {', '.join(draws)}" if draws else "nothing draws here: mend torch, then cpu")
    return {
        "command": "doctor", "version": package_version(), "draws": draws, "exit_code": 0 if draws else 1,
        "findings": [finding.as_dict() for finding in findings], "seconds": seconds,
    }  # fmt: skip
