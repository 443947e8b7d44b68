"""CPU seconds and peak memory of ``clod_adapter.load`` of one large PLY, each run in a process of
its own.

    # 4,000,000 Gaussians: 1 GB of disk, 3 GB of memory
    python benchmarks/loading.py --record
    # in turn with another version
    python benchmarks/loading.py --against OLDER_CHECKOUT/.venv/bin/python
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

from clod_adapter.io.ply_layout import inria_dtype
from common import ROOT, Row, append, arguments

import numpy as np

FILE = "scaling.jsonl"
LOAD = """
import json, resource, sys, time
from clod_adapter.io.checkpoint import load
before, began = time.process_time(), time.perf_counter()
checkpoint = load(sys.argv[1])
seconds, cpu = time.perf_counter() - began, time.process_time() - before
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
count = len(checkpoint.gaussians)
print(json.dumps({"count": count, "seconds": seconds, "cpu": cpu, "peak_mb": peak}))
"""


def write_ply(path: Path, count: int) -> None:
    """Random Gaussians of SH degree 3 in Inria's layout, in pieces."""
    names = inria_dtype(3).names
    properties = "".join(f"property float {name}\n" for name in names)
    random = np.random.default_rng(0)
    with open(path, "wb") as file:
        header = f"ply\nformat binary_little_endian 1.0\nelement vertex {count}\n"
        file.write(f"{header}{properties}end_header\n".encode())
        for start in range(0, count, 1 << 16):
            rows = random.normal(size=(min(1 << 16, count - start), len(names)))
            file.write(rows.astype("<f4").tobytes())


def main() -> None:
    parser = arguments(__doc__, record=FILE)
    parser.add_argument("--count", type=int, default=4_000_000)
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--against", help="the Python of another version's environment")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "large.ply"
        write_ply(path, args.count)
        versions = {"this": (sys.executable, ROOT)}
        if args.against:
            versions["other"] = (args.against, Path(folder))
        runs: dict[str, list[Row]] = {name: [] for name in versions}
        for _ in range(args.runs):
            for name, (python, place) in versions.items():
                words = [python, "-c", LOAD, str(path)]
                done = subprocess.run(words, cwd=place, stdout=subprocess.PIPE, check=True)
                runs[name].append(json.loads(done.stdout))
    for name, rows in runs.items():
        least = {}
        for key in rows[0]:
            least[key] = round(min(row[key] for row in rows), 2)
        print(name, least)
        if args.record and name == "this":
            append(FILE, {"benchmark": "loading", **least})


if __name__ == "__main__":
    main()
