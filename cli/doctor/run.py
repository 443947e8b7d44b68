"""``clod-adapt doctor``: checks every backend and tool, and prints for each a result and a fix."""

from __future__ import annotations

import argparse
import time
from dataclasses import asdict
from typing import Any

from clod_adapter._support.version import package_version

from ..shared.console import Console, put
from .backends import BACKENDS
from .checks import Check, Probe
from .tools import TOOLS

RENDERERS = ("cpu", "gpu")  # backends of the other commands
PROBES: dict[str, Probe] = BACKENDS | TOOLS


def run(args: argparse.Namespace) -> dict[str, Any]:
    """Runs all checks; the report's exit code is 1 where neither the CPU nor the GPU backend works."""
    console, checks, seconds = Console(args.quiet), list[Check](), dict[str, float]()
    with console.status("checking ...") as show:
        for name, probe in PROBES.items():
            show(f"checking {name} ({len(checks) + 1} of {len(PROBES)}) ...")
            began = time.perf_counter()
            checks.append(Check.run(name, probe))
            seconds[name] = round(time.perf_counter() - began, 3)
    width = max(map(len, PROBES)) + 2
    draws = [check.name for check in checks if check.ok and check.name in RENDERERS]
    put("\n".join(check.line(width) for check in checks))
    failed = "no rendering backend works: fix torch first, then the CPU backend"
    print(f"rendering and training backends: {', '.join(draws)}" if draws else failed)
    return {
        "command": "doctor", "version": package_version(), "draws": draws, "exit_code": 0 if draws else 1,
        "findings": [asdict(check) for check in checks], "seconds": seconds,
    }  # fmt: skip
