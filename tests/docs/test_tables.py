"""Tables of the pages are what the rows of the benchmarks give, of one commit and machine; tasks
whose rows are of this commit are not run again.
"""

import json
import re
import runpy
import shutil

import pytest
import results
from common import ROOT

LEFT_OUT = shutil.ignore_patterns("cache", "faults", "images", "__pycache__")
# what runs the tasks, and what has no number
OTHERS = {"results.py", "faults.py"}


@pytest.fixture
def copy(tmp_path):
    """Pages and benchmarks with their rows, which a test may alter."""
    for folder in ("docs", "benchmarks"):
        shutil.copytree(ROOT / folder, tmp_path / folder, ignore=LEFT_OUT)
    return tmp_path


def alter(file, change, **where):
    """Changes the last row that has these values."""
    rows = [json.loads(line) for line in file.read_text("utf-8").splitlines()]
    change([row for row in rows if where.items() <= row.items()][-1])
    file.write_text("".join(json.dumps(row) + "\n" for row in rows), "utf-8")


def test_the_build_names_tables_of_other_rows(copy, monkeypatch, capfd):
    rows = copy / "benchmarks" / "results"
    alter(rows / "stream.jsonl", lambda row: row.update(commit="0ld"), scene="taebak4")
    alter(rows / "stability.jsonl", lambda row: row["machine"].update(threads=7), part="popping")
    alter(rows / "walk.jsonl", lambda row: row["dial"][0].update(psnr=99.0))
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(copy / "docs" / "make.py"), run_name="__main__")
    stream, popping, walk = capfd.readouterr().err.splitlines()
    assert ended.value.code == 1 and not (copy / "build").exists()
    of = r"has rows of several commits or machines \((.*)\): run make results ONLY="
    commits = re.fullmatch(
        f'docs/performance.md: table stream-taebak4 {of}"stream-taebak4"', stream
    )
    assert re.fullmatch("0ld on .*; [0-9a-f]{8} on .*", commits[1])
    machines = re.fullmatch(
        f'docs/performance.md: table stability-popping {of}"stability.*', popping
    )
    assert re.fullmatch(".* 2 threads; .* 7 threads", machines[1])
    assert walk.startswith("docs/method.md: table walk is not what its rows give")
    assert walk.endswith('run make results ONLY="walk"')


def test_tables_are_written_between_their_marks(copy, monkeypatch, capsys):
    page = copy / "docs" / "method.md"
    text = page.read_text("utf-8")
    monkeypatch.setattr(results, "PAGES", [page])
    assert results.build_pages(write=True) == 0 and page.read_text("utf-8") == text
    page.write_text(text.replace("| beyond |", "| there |").replace(": adapt -->", ": x -->"))
    assert results.build_pages(write=True) == 1
    assert page.read_text("utf-8") == text.replace(": adapt -->", ": x -->")
    said = capsys.readouterr()
    assert said.out == "docs/method.md: table walk is new\n"
    assert said.err == "docs/method.md: no benchmark has a table x\n"


def test_what_is_done_or_cannot_run_is_skipped(monkeypatch, capsys):
    (task,) = results.chosen(["walk"], False)
    (row,) = task.rows()
    monkeypatch.setattr(results.Task, "run", lambda task: print("ran", task.name) or 3)
    monkeypatch.setattr(results, "about", lambda: {**row, "commit": "another"})
    assert results.run([task]) == 1 and "ran walk" in capsys.readouterr().out
    monkeypatch.setattr(results, "about", lambda: row)
    assert results.run([task]) == 0
    assert re.match("skipped: walk .* done\n0 tasks", capsys.readouterr().out)
    monkeypatch.setenv("CLOD_SCENES", "nowhere")
    assert results.run(results.chosen(["stream-garden2"], False)) == 0
    assert "cannot run here, needs $CLOD_SCENES/garden2.ply" in capsys.readouterr().out


def test_names_choose_tasks():
    def names(*words):
        return [task.name for task in results.chosen(words, False)]

    assert names("adapt", "stability-popping") == ["stability", "adapt-20", "adapt-7"]
    assert all(results.chosen([name], False) for name in results.TABLES)
    with pytest.raises(SystemExit, match="no task is called nothing"):
        names("nothing")
    short, long = (results.chosen([], long) for long in (False, True))
    assert len(short) + len(long) == len(results.tasks()) and short and long


def test_every_benchmark_of_the_pages_is_a_task():
    pages = (ROOT / "README.md", *(ROOT / "docs").glob("*.md"))
    named = set()
    for page in pages:
        named |= set(re.findall(r"benchmarks/(\w+\.py)", page.read_text("utf-8")))
    commands = [task.command.split()[1].removeprefix("benchmarks/") for task in results.tasks()]
    assert named - OTHERS <= set(commands)
    assert all((ROOT / "benchmarks" / script).is_file() for script in commands)
    assert {name for task in results.tasks() for name in task.tables} <= set(results.TABLES)


def test_no_row_names_a_path_of_the_machine():
    for file in (ROOT / "benchmarks" / "results").iterdir():
        assert not re.search(r'"/\w+/', file.read_text("utf-8")), file.name
