"""Damaged files of every input format: each must be read, or refused with ClodError, quickly and in little memory.

    python benchmarks/fuzz.py --cases 20000 --format colmap --seed 3 --record
    python benchmarks/fuzz.py --format ply --seed 0 --case 4711 --keep /tmp/it    # one case, its files kept

A case is an input (mutants.py) that is damaged (damage.py) at random from its seed and number. A failure is any other
result: another exception, a process that dies (COLMAP is C++) or takes more than LIMIT_S, more than LIMIT_MB of memory
beyond that of undamaged inputs, a refused allocation, a warning, a message of several lines or without the file's name,
a file opened outside of the case's folder, a program started, a connection made.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import random
import resource
import signal
import sys
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any

import clod_adapter as clod
from clod_adapter.cli.adapt.resume import find_state
from clod_adapter.cli.shared.console import Console
from common import Row, append, arguments
from damage import mutate
from mutants import MAKERS, Input, write, write_images

import torch

FILE = "fuzz.jsonl"
LIMIT_S, LIMIT_MB = 10.0, 64
BATCH = 5000  # cases a process
MANY = 50  # processes that died, after which a format is given up
SHARES = {"ply": 0.3, "safetensors": 0.15, "colmap": 0.2, "transforms": 0.1, "pt": 0.05, "models": 0.2, "states": 0.05}
HARMFUL = ("os.system", "os.exec", "os.posix_spawn", "subprocess.Popen", "socket.connect", "ctypes.dlopen")
# Fields of the shared memory of a worker and its parent.
CASE, READ, REFUSED, SLOWEST_US, SLOWEST, EXTRA_KB = range(6)


class Watch:
    """Files opened and programs started while a case is read."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.on, self.seen = str(folder), False, [""][:0]
        sys.addaudithook(self.hear)

    def hear(self, event: str, args: tuple[Any, ...]) -> None:
        if not self.on:
            return
        if event in HARMFUL:
            self.seen.append(f"{event} {args[:1]}")
        elif event == "open" and isinstance(args[0], str | bytes | os.PathLike):
            path = os.path.realpath(os.fsdecode(args[0]))
            if not path.startswith((self.folder, sys.prefix, sys.base_prefix, "/dev/", "/proc/", "/sys/")):
                self.seen.append(f"opened {path}")


def read(kind: str, folder: Path, case: Input, number: int) -> None:
    if kind in ("colmap", "transforms"):
        clod.load_scene(folder)
    elif kind == "safetensors":
        clod.load_adapter(folder / next(iter(case)))
    elif kind == "states":
        resumed = find_state(folder / next(iter(case)), True, clod.AdaptConfig(), Console(quiet=True))
        if resumed is None:
            raise AssertionError("the state was not read")
    else:
        clod.load(folder / next(iter(case)), activated=None if number % 2 else "both")


def damaged(kind: str, inputs: list[Input], seed: int, number: int) -> Input:
    chance = random.Random(f"{kind} {seed} {number}")
    return mutate(chance.choice(inputs), inputs, chance)


def place(kind: str, folder: Path) -> Path:
    """Where the files of a case go."""
    target = folder / "sparse" / "0" if kind == "colmap" else folder
    target.mkdir(parents=True, exist_ok=True)
    return target


def result_of(kind: str, folder: Path, case: Input, number: int, watch: Watch) -> str:
    """ "read", "refused", or a description of the failure."""
    watch.seen.clear()
    watch.on = True
    try:
        with warnings.catch_warnings(action="error"):
            read(kind, folder, case, number)
        result = "read"
    except clod.ClodError as error:
        cause: BaseException | None = error
        while cause is not None and not isinstance(cause, MemoryError):
            cause = cause.__cause__ or cause.__context__
        result = "refused" if cause is None else f"was out of memory: {error}"
        if "\n" in str(error) or str(folder) not in str(error):
            result = f"message of many lines, or without the file's name: {error}"
    except Exception as error:
        result = f"{type(error).__name__}: {error}"
    finally:
        watch.on = False
    return f"harm: {watch.seen[:3]}" if watch.seen else result


def work(kind: str, inputs: list[Input], seed: int, cases: range, folder: Path, shared: Any, failures: Path) -> None:
    """A batch of cases, in a process of its own with little memory; results go to ``shared`` and ``failures``."""
    watch, target = Watch(folder), place(kind, folder)
    os.environ["XDG_CACHE_HOME"] = str(folder / "cache")  # where load_scene puts undistorted photographs
    for case in inputs:
        write(case, target)
        read(kind, folder, case, 0)
    virtual = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (virtual + (1 << 30), resource.RLIM_INFINITY))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for number in cases:
        shared[CASE] = number
        case = damaged(kind, inputs, seed, number)
        write(case, target)
        began = time.perf_counter()
        result = result_of(kind, folder, case, number, watch)
        microseconds = int((time.perf_counter() - began) * 1e6)
        extra = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
        if extra - shared[EXTRA_KB] > LIMIT_MB * 1024:
            result = f"took {extra // 1024} MB"
        shared[EXTRA_KB] = max(shared[EXTRA_KB], extra)
        if microseconds > shared[SLOWEST_US]:
            shared[SLOWEST_US], shared[SLOWEST] = microseconds, number
        if result in ("read", "refused"):
            shared[READ if result == "read" else REFUSED] += 1
        else:
            with open(failures, "a", encoding="utf-8") as out:
                out.write(json.dumps([number, result]) + "\n")


def run(kind: str, seed: int, cases: int, folder: Path) -> Row:
    """All cases of a format, batch by batch; a process that dies or hangs loses its current case."""
    inputs, found, extra = MAKERS[kind](folder), dict[int, str](), 0
    write_images(folder / "case" / "images")
    failures, fork = folder / "failures.jsonl", multiprocessing.get_context("fork")
    shared = fork.Array("q", 6, lock=False)
    start = 0
    while start < cases and len(found) < MANY:
        stop = min(start + BATCH, cases)
        arguments = (kind, inputs, seed, range(start, stop), folder / "case", shared, failures)
        shared[CASE] = start
        process = fork.Process(target=work, args=arguments)
        process.start()
        died = wait(process, shared)
        if died:
            found[shared[CASE]] = died
        start = shared[CASE] + 1 if died else stop
        extra = max(extra, shared[EXTRA_KB])
        shared[EXTRA_KB] = 0
        print(f"{kind}: {start} of {cases}", file=sys.stderr)
    for line in failures.read_text(encoding="utf-8").splitlines() if failures.exists() else []:
        number, result = json.loads(line)
        found[number] = result
    failures.unlink(missing_ok=True)
    return {
        "cases": cases, "read": shared[READ], "refused": shared[REFUSED], "failures": found,
        "slowest_s": shared[SLOWEST_US] / 1e6, "slowest_case": shared[SLOWEST], "extra_mb": extra / 1024,
    }  # fmt: skip


def wait(process: Any, shared: Any) -> str:
    """Until the process ends, or has been at one case for too long; says how it died, if it did."""
    case, since = -1, time.monotonic()
    while process.is_alive():
        process.join(0.2)
        if shared[CASE] != case:
            case, since = shared[CASE], time.monotonic()
        elif time.monotonic() - since > LIMIT_S:
            process.kill()
            process.join()
            return f"took more than {LIMIT_S:g} s"
    code = process.exitcode
    return "" if code == 0 else signal.Signals(-code).name if code < 0 else f"the process ended with {code}"


def again(kind: str, seed: int, number: int, folder: Path) -> None:
    """One case in this process, its files left in ``folder``."""
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch:
        inputs = MAKERS[kind](Path(scratch))
    case = damaged(kind, inputs, seed, number)
    write_images(folder / "images")
    write(case, place(kind, folder))
    read(kind, folder, case, number)


def main() -> None:
    parser = arguments(__doc__, record=FILE)
    parser.add_argument("--cases", type=int, default=200_000, help="over all formats; of states a twentieth more")
    parser.add_argument("--format", choices=MAKERS, help="this one alone")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--case", type=int, help="this one alone, in this process")
    parser.add_argument("--keep", type=Path, default=Path("case"), help="with --case: where its files go")
    args = parser.parse_args()
    torch.set_num_threads(1)
    if args.case is not None:
        again(args.format, args.seed, args.case, args.keep)
        return
    shares, began, tallies = {args.format: 1.0} if args.format else SHARES, time.perf_counter(), {}
    for kind, share in shares.items():
        with tempfile.TemporaryDirectory(dir="/dev/shm" if os.path.isdir("/dev/shm") else None) as folder:
            tallies[kind] = run(kind, args.seed, round(args.cases * share), Path(folder).resolve())
    row = {
        "seed": args.seed, "cases": sum(tally["cases"] for tally in tallies.values()),
        "failures": sum(len(tally["failures"]) for tally in tallies.values()),
        "seconds": time.perf_counter() - began, "formats": tallies,
    }  # fmt: skip
    for kind, tally in tallies.items():
        for number, failure in tally["failures"].items():
            print(f"{failure}\n  python benchmarks/fuzz.py --format {kind} --seed {args.seed} --case {number}")
    if args.record:
        append(FILE, row)
    else:
        print(json.dumps(row, indent=1))
    sys.exit(1 if row["failures"] else 0)


if __name__ == "__main__":
    main()
