"""Runs the command in hostile surroundings, each as a shell line with the exit code that is right.

    PYTHONPATH=benchmarks python tests/hostile.py    # several minutes
    PYTHONPATH=benchmarks python tests/hostile.py --only --batch    # the lines with this text

A failure is another exit code, a traceback or a warning, an error that is not one last line, an
input that changed, or other new files than expected.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from city import write_city

SCENE = "base.ply --images scene --iters 2 --max-sv 2 --accept-loss -o new.ply"
EVAL = "eval base.ply --images scene --sv 1 --quiet"
FILES = ("new.json", "new.ply", "new.safetensors")
NOISE = re.compile(
    r"Traceback|\w+Warning:|warn\(|Segmentation|core dumped|FATAL|terminate called|this is a bug"
)
SECONDS = 120


@dataclass(frozen=True)
class Case:
    """A shell line, in which ``clod-adapt`` is the command.

    Attributes:
        code: the exit code.
        new: the files that it leaves.
        told: whether stderr, and so the error, can be read.
    """

    line: str
    code: int = 2
    new: tuple[str, ...] = ()
    told: bool = True


def streams():
    yield Case("clod-adapt --version >&-")
    yield Case("clod-adapt --help >/dev/full")
    for stdout in (">&-", "--json >&-", "--json >/dev/full"):
        yield Case(f"clod-adapt inspect base.ply {stdout}")
    yield Case("set -o pipefail; clod-adapt inspect base.ply | true")
    yield Case("clod-adapt inspect missing.ply 2>&-", told=False)
    yield Case(f"clod-adapt {SCENE} <&- >&- 2>&-", 0, FILES)
    yield Case(f"clod-adapt {SCENE} >/dev/full 2>/dev/full", 0, FILES)
    yield Case("clod-adapt export base.ply -o new.spz >&-", 0, ("new.spz",))


VARIABLES = """
NUMBA_NUM_THREADS=0
NUMBA_NUM_THREADS=x
OMP_NUM_THREADS=abc
TMPDIR=/missing
-u HOME
HOME=
COLUMNS=0
COLUMNS=1
COLUMNS=x
TERM=
LANG=xx_YY.z
LC_ALL=C
PYTHONOPTIMIZE=2
PYTHONWARNINGS=error
PYTHONIOENCODING=ascii
PYTHONUTF8=0
XDG_CACHE_HOME=/proc/x
NUMBA_CACHE_DIR=/proc/x
CUDA_VISIBLE_DEVICES=x
RANK=x
WORLD_SIZE=3
-i PATH="$PATH"
"""
PATHS = r"""
base.ply -o ""
base.ply --out=
base.ply --images ""
""
inspect ""
export base.ply -o ""
base.ply -o /proc/x.ply
base.ply -o /dev/null
inspect /dev/zero
inspect /proc/self/mem
inspect .
inspect /proc/self/environ
base.ply --images /proc/self
base.ply --images /dev
inspect "$(printf "a%.0s" $(seq 5000))"
inspect $'a\nb.ply'
inspect $'\xff.ply'
export base.ply -o new
export base.ply -o new.zip
export base.ply -o missing/new.ply
"""
ADAPT = """
--iters nan
--iters 1e3
--iters -1
--iters 0x10
--max-sv nan
--max-sv inf
--max-sv 0
--max-sv 1e400
--batch 0
--batch 1000000
--batch 1.5
--seed -1
--seed 99999999999999999999
--time-budget 0
--time-budget nan
--time-budget inf
--memory 0
--memory nan
--memory 8XB
--memory 1e400GB
--with x
--missing
--iters $(printf 1%.0s $(seq 100000))
--max-sv
"""
EVALUATE = """
--sv nan
--sv inf
--sv -1
--keep 0
--keep nan
--psnr-drop 0
--fps inf
--sv
"""
EXPORT = """
--levels nan
--levels 1,,2
--levels 1,1
--camera ../x --images scene
"""


def of_lines(command, lines):
    """The command with the words of each line, all refused."""
    for words in lines.strip().splitlines():
        yield Case(f"{command} {words}")


def environments():
    for variables in VARIABLES.strip().splitlines():
        yield Case(f"env {variables} clod-adapt {EVAL}", 0)
    yield Case(f"env TMPDIR=/missing HOME=/missing clod-adapt {SCENE}", 0, FILES)


def folders():
    yield Case("mkdir gone; cd gone; rmdir ../gone; clod-adapt inspect ../base.ply")
    yield from of_lines("clod-adapt", PATHS)
    yield Case("mkfifo p.ply; timeout 20 clod-adapt inspect p.ply; code=$?; rm p.ply; exit $code")
    yield Case(
        "ln -s loop.ply loop.ply; clod-adapt inspect loop.ply; code=$?; rm loop.ply; exit $code"
    )


def options():
    yield from of_lines("clod-adapt base.ply --images scene -o new.ply", ADAPT)
    yield from of_lines("clod-adapt eval base.ply --images scene", EVALUATE)
    yield from of_lines("clod-adapt export base.ply -o new.ply", EXPORT)
    for port in ("-1", "65536", "nan"):
        yield Case(f"clod-adapt view base.ply --no-browser --port {port}")


def write_inputs(folder):
    """A small town's checkpoint, ``base.ply``, and ten photographs of it, ``scene``."""
    write_city(folder / "scene", 1000, 10, 64, 48)
    (folder / "scene" / "city.ply").rename(folder / "base.ply")


def failures(case, inputs):
    """What is wrong with the case, in a copy of the inputs."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        shutil.copyfile(inputs / "base.ply", folder / "base.ply")
        shutil.copytree(inputs / "scene", folder / "scene")
        before = contents(folder)
        script = case.line.replace("clod-adapt", f"{sys.executable} -m clod_adapter")
        try:
            done = subprocess.run(
                ["bash", "-c", script], cwd=folder, capture_output=True, timeout=SECONDS
            )
        except subprocess.TimeoutExpired:
            return [f"takes more than {SECONDS} s"]
        after = contents(folder)
    stderr = done.stderr.decode(errors="replace")
    wrong = []
    if done.returncode != case.code:
        wrong.append(f"exit code {done.returncode}")
    if match := NOISE.search(stderr):
        wrong.append(f"prints {match[0]}")
    lines = [line for line in stderr.splitlines() if line]
    errors = [line for line in lines if line.startswith("clod-adapt: error: ")]
    if done.returncode == 2 and case.told and (errors != lines[-1:] or len(errors[0]) > 11_000):
        wrong.append("no error in one last line")
    if not before.items() <= after.items():
        wrong.append("changes an input")
    new = {name for name in after.keys() - before.keys() if "/" not in name}
    if new != set(case.new):
        wrong.append(f"leaves {sorted(new)}")
    return [*wrong, *lines[-5:]] if wrong else []


def contents(folder):
    files = (path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default="", help="only the lines with this text")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as name, ThreadPoolExecutor(os.cpu_count()) as pool:
        write_inputs(inputs := Path(name))
        cases = (*streams(), *environments(), *folders(), *options())
        chosen = [case for case in cases if args.only in case.line]
        failed = 0
        results = pool.map(partial(failures, inputs=inputs), chosen)
        for case, lines in zip(chosen, results, strict=True):
            if lines:
                failed += 1
                print(case.line[:200], *(line[:300] for line in lines), sep="\n  ", flush=True)
    print(f"{len(chosen)} cases, {failed} failures")
    sys.exit(failed > 0)


if __name__ == "__main__":
    main()
