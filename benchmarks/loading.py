"""CPU seconds and peak memory of ``clod_adapter.load`` of one large PLY, each run in a process of
its own.

python benchmarks/loading.py --record                         # 4,000,000 Gaussians: 1 GB of disk, 3
GB of memory python benchmarks/loading.py --against OLDER_CHECKOUT/.venv/bin/python    # in turn
with another version
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

from common import ROOT, append, arguments

import numpy as np

FILE = "scaling.jsonl"
LOAD = """
import json, resource, sys, time
from clod_adapter.io.checkpoint import load
before, began = time.process_time(), time.perf_counter()
found = load(sys.argv[1])
seconds, cpu = time.perf_counter() - began, time.process_time() - before
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
print(json.dumps({"count": len(found.gaussians), "seconds": seconds, "cpu": cpu, "peak_mb": peak}))
"""


def write_ply(path: Path, count: int) -> None:
    """Random Gaussians of SH degree 3 in Inria's layout, in pieces."""
    rest = [f"f_rest_{k}" for k in range(45)]
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *rest, "opacity"]
    names += [*(f"scale_{k}" for k in range(3)), *(f"rot_{k}" for k in range(4))]
    properties = "".join(f"property float {name}\n" for name in names)
    random = np.random.default_rng(0)
    with open(path, "wb") as file:
        header = (
            "ply\nformat binary_little_endian 1.0\nelement vertex"
            f" {count}\n{properties}end_header\n"
        )
        file.write(header.encode())
        for start in range(0, count, 1 << 16):
            file.write(
                random.normal(size=(min(1 << 16, count - start), len(names)))
                .astype("<f4")
                .tobytes()
            )


def main() -> None:
    parser = arguments(__doc__, record=FILE)
    parser.add_argument("--count", type=int, default=4_000_000)
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--against", help="the Python of another version's environment")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "large.ply"
        write_ply(path, args.count)
        found: dict[str, list[dict[str, float]]] = {"this": [], "other": []}
        for _ in range(args.runs):
            for name, python in (
                ("this", sys.executable),
                *([("other", args.against)] if args.against else []),
            ):
                done = subprocess.run(
                    [python, "-c", LOAD, str(path)],
                    cwd=ROOT if name == "this" else folder,
                    capture_output=True,
                    text=True,
                    check=True,
                )
                found[name].append(json.loads(done.stdout))
    for name, runs in found.items():
        if runs:
            least = {key: round(min(run[key] for run in runs), 2) for key in runs[0]}
            print(name, least)
            if args.record and name == "this":
                append(FILE, {"benchmark": "loading", **least})


if __name__ == "__main__":
    main()
