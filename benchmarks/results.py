"""Runs the benchmarks behind the numbers of README and docs, and writes the tables of the pages.

    python benchmarks/results.py    # make results: an evening on two cores
    python benchmarks/results.py stream nophoto    # make results ONLY="stream nophoto"
    python benchmarks/results.py --long    # make results-long: tasks of half an hour or more
    python benchmarks/results.py --list    # every task, with its forecast and the state of its rows
    python benchmarks/results.py --pages    # only writes the tables, from the stored rows
    python benchmarks/results.py --check    # only compares them, as make docs does

``tasks.toml`` has the tasks. One is done, and skipped, if its rows are of this commit and
processor; so an interrupted run goes on where it stopped. A table stands on its page between
``<!-- table: NAME -->`` and ``<!-- end of table -->``; its rows must be of one commit and machine.
"""

import os
import re
import shlex
import shutil
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial

import adapt
import choices
import converged
import file_formats
import nophoto
import paper
import rasterize
import rivals
import robustness
import scaling
import stability
import stream
import walk
from common import ROOT, SHARED, Table, about, arguments, last

PAGES = [ROOT / "docs" / f"{name}.md" for name in ("performance", "method", "formats")]
MARKED = re.compile(r"^( *)<!-- table: (\S+) -->\n(.*?)^ *<!-- end of table -->", re.M | re.S)
LONG = 30  # minutes
TABLES: dict[str, Callable[[], Table]] = {
    "adapt": adapt.page_table,
    "choices": choices.page_table,
    "choices-placed": choices.placed_table,
    "converged": converged.page_table,
    "formats": file_formats.page_table,
    "nophoto": nophoto.page_table,
    "paper-ablation": paper.page_table,
    "paper-strips": paper.strips_table,
    "rasterize": rasterize.page_table,
    "robustness": robustness.page_table,
    "scaling": scaling.page_table,
    "scaling-memory": scaling.memory_table,
    "walk": walk.page_table,
}
for module, parts in (
    (rivals, ("plush_half", "bonsai146")),
    (stability, stability.PARTS),
    (stream, stream.SCENES),
):
    for part in parts:
        TABLES[f"{module.__name__}-{part}"] = partial(module.page_table, part)


@dataclass(frozen=True, kw_only=True)
class Task:
    """A section of ``tasks.toml``, which has the meaning of the fields."""

    name: str
    command: str
    minutes: int
    needs: Sequence[str] = ()
    tables: Sequence[str] = ()
    file: str = ""
    by: Sequence[str] = ()
    where: dict[str, list[str]] = field(default_factory=dict)

    def rows(self):
        found = list(last(self.file, *self.by).values()) if self.file else []
        for name, values in self.where.items():
            found = [row for row in found if row[name] in values]
        for name in self.tables:
            found += TABLES[name]().rows
        return found

    def state(self):
        found = origins(self.rows())
        if len(found) > 1:
            return f"rows of several commits: run {self.name}"
        if found and found[0].rpartition(",")[0] == origin(about()).rpartition(",")[0]:
            return "done"
        return f"rows of {found[0]}" if found else "no rows"

    def absent(self):
        paths = {need: ROOT / os.path.expandvars(need) for need in self.needs}
        return [
            need for need, path in paths.items() if not path.exists() and not shutil.which(need)
        ]

    def run(self):
        """The exit code."""
        words = shlex.split(os.path.expandvars(self.command))
        began = time.perf_counter()
        done = subprocess.run([sys.executable, *words[1:]], cwd=ROOT, check=False)
        took = (time.perf_counter() - began) / 60
        print(f"{self.name}: exit code {done.returncode}, {took:.0f} minutes", flush=True)
        return done.returncode


def origin(row):
    machine = row["machine"]
    return f"{row['commit']} on {machine['cpu']}, {machine['threads']} threads"


def origins(rows):
    return sorted(set(map(origin, rows)))


def tasks():
    import tomllib  # of Python 3.11, which building the pages does not need

    text = (ROOT / "benchmarks" / "tasks.toml").read_text("utf-8")
    return [Task(name=name, **values) for name, values in tomllib.loads(text).items()]


def chosen(names, long):
    """The tasks of these names, or of names that begin so; else all short or all long ones."""
    if not names:
        return [task for task in tasks() if (task.minutes >= LONG) == long]
    found = []
    for task in tasks():
        related = (task.name.startswith(f"{name}-") or task.name == name for name in names)
        if any(related) or any(name in task.tables for name in names):
            found.append(task)
    return found or sys.exit(f"no task is called {' or '.join(names)}; --list has all")


def main():
    parser = arguments(__doc__)
    parser.add_argument("names", nargs="*", metavar="TASK", help="these tasks alone")
    for option in ("--long", "--list", "--pages", "--check"):
        parser.add_argument(option, action="store_true")
    args = parser.parse_args()
    os.environ.setdefault("CLOD_SHARED_DATA", str(SHARED))
    if args.check or args.pages:
        return build_pages(write=args.pages)
    if args.list:
        return list_all()
    try:
        failed = run(chosen(args.names, args.long))
    except KeyboardInterrupt:
        print("\ninterrupted: what is done stays; the same command goes on", file=sys.stderr)
        return 130
    return build_pages(write=True) or failed


def list_all():
    """Prints every task."""
    print(*map(listed, tasks()), sep="\n")
    for target, long in (("results", False), ("results-long", True)):
        minutes = sum(task.minutes for task in chosen([], long))
        print(f"make {target}: {minutes} minutes on two cores")
    return 0


def listed(task):
    absent = task.absent()
    needs = f"; cannot run here, needs {', '.join(absent)}" if absent else ""
    return f"{task.name:20} {task.minutes:4} min  {task.state()}{needs}"


def run(selected):
    """Runs what is not done; 1 if any failed."""
    ready = []
    for task in selected:
        if task.absent() or task.state() == "done":
            print(f"skipped: {listed(task)}")
        else:
            ready.append(task)
    left = sum(task.minutes for task in ready)
    print(f"{len(ready)} tasks, about {left} minutes on two cores", flush=True)
    failed = 0
    for task in ready:
        print(f"{task.name}: about {task.minutes} of {left} minutes; {task.command}", flush=True)
        failed |= task.run() != 0
        left -= task.minutes
    return failed


def build_pages(write):
    """Compares the marked tables with their rows, or writes them; 1 if there are problems."""
    problems = []
    for page in PAGES:
        old = page.read_text("utf-8")
        new = MARKED.sub(partial(rebuilt, page.name, problems, write), old)
        if write and new != old:
            page.write_text(new, encoding="utf-8")
    print(*problems, sep="\n", end="\n" if problems else "", file=sys.stderr)
    return int(bool(problems))


def rebuilt(page, problems, write, found):
    """A marked table as its rows give it; as it is if these are of several commits or machines."""
    indent, name, _ = found.groups()
    hint = f'run make results ONLY="{name}"'
    if name not in TABLES:
        problems.append(f"docs/{page}: no benchmark has a table {name}")
        return found[0]
    table = TABLES[name]()
    if len(origins(table.rows)) != 1:
        several = f"several commits or machines ({'; '.join(origins(table.rows))})"
        problems.append(f"docs/{page}: table {name} has rows of {several}: {hint}")
        return found[0]
    parts = (f"<!-- table: {name} -->", table.markdown(), "<!-- end of table -->")
    text = textwrap.indent("\n\n".join(parts), indent)
    if text != found[0] and write:
        print(f"docs/{page}: table {name} is new")
    elif text != found[0]:
        problems.append(f"docs/{page}: table {name} is not what its rows give: {hint}")
    return text


if __name__ == "__main__":
    sys.exit(main())
