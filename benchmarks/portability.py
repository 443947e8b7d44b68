"""Runs the test suite under conditions in which processors, users, shells and folders differ.

    python benchmarks/portability.py --record    # all conditions: an hour on two idle cores
    # one condition, and two of them at once
    python benchmarks/portability.py plain no_root+c_locale --tests tests/io

Run by another virtual environment's Python it tests the versions that are installed there. The
exit code is 1 where a test failed or a condition could not be had. The conditions:

- ``plain``: as ``make test`` runs it;
- ``aten_default``, ``aten_avx2``, ``mkl_compatible``, ``numba_generic``: vector instructions of
  older processors;
- ``libm_0``, ``libm_1``, ``libm_2``: other last bits of exp, log and the like
  (``tests/other_libm``);
- ``one_thread``, ``one_core``: a single thread; as many as otherwise, on one core;
- ``no_root``: for root, in a user namespace without root's rights; for others ``plain`` is that;
- ``ignored_sigint``, ``blocked_signals``: as a script's background job, and below a program that
  blocks signals;
- ``c_locale``: ASCII as the encoding of files and of the terminal, and a day's time zone away from
  Greenwich;
- ``folders``: temporary files, home and kernel cache in folders with spaces and other letters in
  their names;
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from functools import reduce
from pathlib import Path

from common import ROOT, SHARED, append, arguments, outcomes

FILE = "portability.jsonl"
SPACED = os.fsdecode("a folder, spàced".encode())  # under an ASCII locale too
OTHER_LIBM = str(ROOT / "tests" / "other_libm")
PARALLEL = ["--numprocesses=auto", "--maxprocesses=4", "--dist=loadfile", "--no-loadscope-reorder"]


@dataclass(frozen=True)
class Condition:
    """What is set, in which ``{work}`` is a temporary folder, and the command that starts the
    tests' own.
    """

    environment: dict[str, str] = field(default_factory=dict)
    prefix: tuple[str, ...] = ()

    def __add__(self, other):
        return Condition(self.environment | other.environment, self.prefix + other.prefix)


CONDITIONS = {
    "plain": Condition(),
    "aten_default": Condition({"ATEN_CPU_CAPABILITY": "default"}),
    "aten_avx2": Condition({"ATEN_CPU_CAPABILITY": "avx2"}),
    "mkl_compatible": Condition({"MKL_CBWR": "COMPATIBLE"}),
    "numba_generic": Condition({"NUMBA_CPU_NAME": "generic"}),
    **{f"libm_{n}": Condition({"OTHER_LIBM": str(n), "PYTHONPATH": OTHER_LIBM}) for n in range(3)},
    "one_thread": Condition({"OMP_NUM_THREADS": "1"}),
    "one_core": Condition({}, ("taskset", "--cpu-list", str(min(os.sched_getaffinity(0))))),
    "no_root": Condition({}, ("unshare", "--user") if os.geteuid() == 0 else ()),
    "ignored_sigint": Condition({}, ("env", "--ignore-signal=INT")),
    "blocked_signals": Condition({}, ("env", "--block-signal=INT,TERM")),
    "c_locale": Condition(
        {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0", "TZ": "Pacific/Kiritimati"}
    ),
    "folders": Condition(
        {
            "TMPDIR": "{work}/tmp",
            "HOME": "{work}/home",
            "XDG_CACHE_HOME": "",
            "NUMBA_CACHE_DIR": "{work}/cache",
        }
    ),
}


def run(name, tests):
    """Counts and seconds of the tests under a condition; ``failures`` names those that failed, or
    says why none ran.

    Args:
        name: of a condition, or of several at once, joined by +.
        tests: paths in the checkout; all of its tests where there are none.
    """
    condition = reduce(Condition.__add__, map(CONDITIONS.get, name.split("+")))
    with tempfile.TemporaryDirectory() as outer:
        work = Path(outer) / SPACED
        for folder in ("tmp", "home", "cache"):
            (work / folder).mkdir(parents=True)
        report = Path(outer) / "report.xml"
        pytest = [sys.executable, "-m", "pytest", *PARALLEL, f"--junitxml={report}", *tests]
        environment = {key: value.format(work=work) for key, value in condition.environment.items()}
        environment["CLOD_SHARED_DATA"] = str(SHARED)  # the default is relative to the checkout
        began = time.perf_counter()
        done = subprocess.run(
            [*condition.prefix, *pytest],
            cwd=ROOT,
            env=os.environ | environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            check=False,
        )
        seconds = round(time.perf_counter() - began, 1)
        end = done.stdout.strip()[-200:]
        result = outcomes(report) if report.exists() else {"failures": [end]}
    if done.returncode != 0 and not result["failures"]:
        result["failures"] = [f"exit code {done.returncode}: {end}"]
    return {"passed": 0, "failed": 1, "skipped": 0, **result, "seconds": seconds}


def main():
    parser = arguments(__doc__, record=FILE)
    parser.add_argument("conditions", nargs="*", help="default: each of them; a+b is both at once")
    parser.add_argument(
        "--tests", nargs="+", default=[], metavar="PATH", help="default: all of them"
    )
    args = parser.parse_args()
    unknown = set("+".join(args.conditions or CONDITIONS).split("+")) - set(CONDITIONS)
    if unknown:
        parser.error(
            f"there is no condition {', '.join(sorted(unknown))}; there are {', '.join(CONDITIONS)}"
        )
    failed = False
    for name in args.conditions or CONDITIONS:
        result = run(name, args.tests)
        failed |= bool(result["failures"])
        append(FILE, {"condition": name, "tests": args.tests or ["tests"], **result}, args.record)
    sys.exit(failed)


if __name__ == "__main__":
    main()
