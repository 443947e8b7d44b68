"""Finding and running splat-transform, with substitutes that fail in every way, and reading what it
converts.
"""

import shlex
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from refusals import refused

from clod_adapter.errors import ClodError
from clod_adapter.io.checkpoint import load, save
from clod_adapter.io.file_formats import check_readable, file_has_dial
from clod_adapter.io.formats.splat_transform import INSTALL, VARIABLE, SplatTransform
from scenes import gaussians

BEGIN = "import os, sys, time\nwords = sys.argv[1:]\nsys.stdout.reconfigure(encoding='utf-8')"
# What it answers to questions about itself, before it runs.
ANSWERS = (
    "if '--version' in words or '--list-gpus' in words: sys.exit(print('splat-transform v3.7.2"
    " (abc)'))"
)


@pytest.fixture
def tool(tmp_path, monkeypatch):
    """Makes a substitute that runs these lines of Python with ``words``; the environment names
    it.
    """

    def make(*lines):
        script = tmp_path / "with space" / "tool.py"
        script.parent.mkdir(exist_ok=True)
        script.write_text("\n".join([BEGIN, *lines]))
        monkeypatch.setenv(VARIABLE, shlex.join([sys.executable, str(script)]))

    return make


def test_find(tool, monkeypatch, tmp_path):
    for gpus, has_gpu in (("[0] A GPU", True), ("No GPU adapters found.", False)):
        tool(f"print('splat-transform v3.7.2 (abc)' if words == ['--version'] else {gpus!r})")
        found = SplatTransform.find()
        assert (found.version, found.gpu, found.command[0]) == ("3.7.2", has_gpu, sys.executable)
    for line, message in (
        ("print('splat-transform v2.7.1')", "splat-transform is 2.7.1, 3.7 or newer is needed; "),
        ("print('splat-transform v3.6.9')", "is 3.6.9, 3.7 or newer"),
        ("print('something v9.9.9')", "does not run as splat-transform; it needs Node 22; "),
        (
            "sys.exit('SyntaxError: in an old Node')",
            "does not run as splat-transform; it needs Node 22; ",
        ),
    ):
        tool(line)
        with pytest.raises(ClodError) as error:
            SplatTransform.find()
        assert message in str(error.value) and INSTALL in str(error.value)
    monkeypatch.setenv("PATH", str(tmp_path))
    for named, message in (
        ("", "^splat-transform is not installed; in a folder of its own: npm install"),
        (
            "nowhere/tool -g 0",
            "^nowhere/tool, which CLOD_SPLAT_TRANSFORM names, is not installed; ",
        ),
        ("a 'b", "which is no command"),
    ):
        monkeypatch.setenv(VARIABLE, named)
        with refused(message):
            SplatTransform.find()


def test_run(tmp_path, tool):
    out, ticks = tmp_path / "out", []
    tool(ANSWERS, "open(words[-1], 'w').write(' '.join(words[:-1]))", "time.sleep(0.5)")
    found = SplatTransform.find()
    seconds = replace(found, gpu=False).run("a.ply", out, timeout=60, progress=ticks.append)
    assert out.read_text() == "-w -g cpu -i 1 a.ply" and 0.5 < seconds < 30
    assert len(ticks) > 1 and ticks == sorted(ticks) and ticks[-1] <= seconds
    replace(found, gpu=True).run(Path("-a.ply"), out, timeout=60)
    assert out.read_text() == f"-w {Path.cwd() / '-a.ply'}"
    log = [
        "print('splat-transform v3.7.0')",
        "print('  \\u2717 Error: no room')",
        "print('    at f (x.mjs:1)')",
    ]
    for lines, message in (
        ([*log, "print('\\u2717 failed in 0.1s')", "sys.exit(1)"], "Error: no room"),
        (["sys.stderr.write('first\\nlast\\n')", "sys.exit(3)"], "last"),
        (["sys.exit(1)"], "no output"),
    ):
        tool(*lines)
        with refused(f"^splat-transform 3.7.2 failed: {message}$"):
            found.run(timeout=60)


def test_converted_files(tmp_path, tool, monkeypatch):
    was = gaussians(5, 1, 0)
    save(tmp_path / "plain.ply", was)
    seen, plain = repr(str(tmp_path / "seen")), repr(str(tmp_path / "plain.ply"))
    tool(
        ANSWERS,
        f"open({seen}, 'w').write(' '.join(words))",
        f"import shutil; shutil.copy({plain}, words[-1])",
    )
    for name in ("a.KSPLAT", "a.spz"):
        path = tmp_path / name
        path.write_bytes(b"NGSP, if it is an SPZ: of version 4")
        check_readable(path)
        assert not file_has_dial(path)
        found = load(path)
        assert torch.equal(found.gaussians.means, was.means) and "quantised" in found.notes[0]
        assert f" {path} " in (tmp_path / "seen").read_text()
    (tmp_path / "a.sog").write_bytes(b"PK")
    tool(ANSWERS, "sys.stderr.write('  Error: not a zip\\n   at main\\n')", "sys.exit(1)")
    with refused(r"a.sog: cannot be read \(.*failed: Error: not a zip\)"):
        load(tmp_path / "a.sog")
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv(VARIABLE)
    for read in (check_readable, load):
        with refused("a.sog: .*npm install node@22 @playcanvas/splat-transform"):
            read(tmp_path / "a.sog")
