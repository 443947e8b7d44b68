"""``eval``, ``apply``, the help, and what every command does with bad input."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import clod_adapter
from clod_adapter.cli.main import COMMANDS
from clod_adapter.version import package_version

ROW = {"virtual_scale", "psnr", "ssim", "kept", "kept_share", "in_view", "frame_ms"}
TINY = ("--iters", 3, "--quiet", "--out", "dial.ply")


def notes_of(report: Any) -> list[str]:
    """Without the one on LPIPS and FLIP, which depends on what is installed."""
    return [note for note in report["notes"] if not note.startswith("without ")]


def test_eval_prints_one_object(spawn: Any, clod: Any, capture: Any, tmp_path: Path) -> None:
    clod(capture.ply, "--images", capture.scene, *TINY)
    process = spawn("eval", "dial.ply", "--images", capture.scene, "--sv", "1", "2.5", "--json", cwd=tmp_path)
    out, err = process.communicate(timeout=100)
    assert process.returncode == 0, err
    report = json.loads(out)
    assert (report["model"], report["scene"], report["base_count"]) == ("dial.ply", str(capture.scene), 300)
    assert [row["virtual_scale"] for row in report["rows"]] == [1, 2.5]
    for row in report["rows"]:
        assert set(row) - {"lpips", "flip"} == ROW and row["in_view"] <= row["kept"]
        assert row["kept_share"] == row["kept"] / 300 and row["frame_ms"] > 0
        assert 0 < row["psnr"] < 100 and 0 < row["ssim"] <= 1
    assert "PSNR dB" in err and "PSNR dB" not in out


def test_eval_of_a_plain_file(clod: Any, capture: Any) -> None:
    done = clod("eval", capture.ply, "--images", capture.scene, "--json")
    report = json.loads(done.out)
    assert [row["virtual_scale"] for row in report["rows"]] == [1, 2, 3, 5]
    assert {row["kept_share"] for row in report["rows"]} == {1.0} and len({row["psnr"] for row in report["rows"]}) == 1
    assert report["attenuation"] is None and "has no sigma_d" in done.err
    shown = clod("eval", capture.ply, "--images", capture.scene, "--quiet")
    assert len(shown.out.splitlines()) == 5 and shown.err == ""


def test_eval_stays_within_what_was_trained(clod: Any, capture: Any) -> None:
    for max_sv, dials in ((2.5, [1, 2, 2.5]), (1, [1]), (7, [1, 2, 3, 5, 7])):
        clod(capture.ply, "--images", capture.scene, *TINY, "--max-sv", max_sv)
        report = json.loads(clod("eval", "dial.ply", "--images", capture.scene, "--json").out)
        assert [row["virtual_scale"] for row in report["rows"]] == dials and notes_of(report) == []
    done = clod("eval", "dial.ply", "--images", capture.scene, "--sv", 8, "--json")
    (note,) = notes_of(json.loads(done.out))
    assert note.startswith("trained up to s = 7") and note in done.err


def test_apply_gives_the_same_file(clod: Any, capture: Any, tmp_path: Path) -> None:
    clod(capture.ply, "--images", capture.scene, *TINY)
    done = clod("apply", capture.ply, "dial.safetensors", "-o", "again.ply", "--json")
    assert done.code == 0 and (tmp_path / "again.ply").read_bytes() == (tmp_path / "dial.ply").read_bytes()
    assert json.loads(done.out)["outputs"] == {"ply": "again.ply"}


def test_apply_refuses_another_base(clod: Any, capture: Any, tmp_path: Path) -> None:
    clod(capture.ply, "--images", capture.scene, *TINY)
    other = capture.write(tmp_path / "other.ply", capture.gaussians.replace(sh0=capture.gaussians.sh0 + 1e-3))
    done = clod("apply", other, "dial.safetensors", "-o", "again.ply")
    assert_refused(done, f"{other}: a different base")
    assert not (tmp_path / "again.ply").exists()


@pytest.fixture
def bad(tmp_path: Path, capture: Any) -> dict[str, Path]:
    """Things that may be given by mistake."""
    (tmp_path / "text.ply").write_text("hello")
    (tmp_path / "empty").mkdir()
    (tmp_path / "cut.ply").write_bytes(capture.ply.read_bytes()[:-100])
    (tmp_path / "mine.ply").write_bytes(capture.ply.read_bytes())
    (tmp_path / "folder.ply").mkdir()
    clod_adapter.save(tmp_path / "dialled.ply", clod_adapter.attach(capture.gaussians))
    scene = capture.scene
    return {"PLY": capture.ply, "SCENE": scene, "SCENE/images": scene / "images", "DIALLED": Path("dialled.ply")}


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("", "arguments are required: PLY .*--help"),
        ("PLY --images", "--images: expected one argument"),
        ("missing.ply --images SCENE", "missing.ply: .*No such file.*check the path"),
        ("text.ply --images SCENE", "text.ply: is not a PLY.*convert"),
        ("cut.ply --images SCENE", "cut.ply: .*truncated.*again"),
        ("PLY --images nowhere", "nowhere: is not a folder; give"),
        ("PLY --images empty", "empty: no COLMAP model.*give the folder"),
        ("PLY --images SCENE --max-sv 0.5", "--max-sv is 0.5, it must be at least 1"),
        ("PLY --images SCENE --max-sv nan", "--max-sv is nan"),
        ("PLY --images SCENE --max-sv 300", "--max-sv is 300, it must be below 50"),
        ("PLY --images SCENE --max-sv big", "--max-sv: invalid float value: 'big'"),
        ("PLY --images SCENE --iters -1", "--iters is -1, it must be at least 0"),
        ("PLY --images SCENE --seed -1", "--seed is -1, it must be at least 0"),
        ("PLY --images SCENE --time-budget 0", "--time-budget is 0.0, it must be positive"),
        ("PLY --images SCENE --time-budget inf", "--time-budget is inf, it must be"),
        ("PLY --images SCENE --time-budget nan", "--time-budget is nan, it must be"),
        ("PLY --images SCENE --device tpu", "invalid choice: 'tpu'"),
        ("PLY --images SCENE --out nowhere/dial.ply", "nowhere/dial.ply: folder nowhere does not exist; create"),
        ("PLY --images SCENE --out dial.splat", "dial.splat: .*must end in .ply"),
        ("PLY --images SCENE --out folder.ply", "folder.ply: is a folder"),
        ("mine.ply --images SCENE --out mine.ply", "mine.ply: is an input file.*choose another"),
        ("mine.ply --images SCENE --out ./empty/../mine.ply", "mine.ply: is an input file"),
        ("eval missing.ply --images SCENE", "missing.ply: .*check the path"),
        ("eval PLY --images SCENE --against PLY text.ply", "text.ply: is not a PLY"),
        ("eval PLY --images SCENE --base missing.ply", "missing.ply: .*check the path"),
        ("eval PLY --images SCENE --sv 1 0.5", "--sv has 0.5, dial values must be at least 1"),
        ("eval PLY --images SCENE --sv", "--sv: expected at least one argument.*clod-adapt eval --help"),
        ("eval PLY --images SCENE --keep 10", "base.ply: has no sigma_d, so no dial for --keep; give it one"),
        ("eval PLY --images SCENE --keep 0", "--keep has 0, it must be positive"),
        ("eval PLY --images SCENE --keep 1.5", "--keep: invalid int value"),
        ("eval PLY --images SCENE --fps nan", "--fps has nan, it must be positive"),
        ("eval PLY --images SCENE --psnr-drop -1", "--psnr-drop has -1, it must be positive"),
        ("eval PLY --images SCENE --sv 2 --keep 10", "--keep: not allowed with argument --sv"),
        ("eval DIALLED --images SCENE --psnr-drop 1", "dialled.ply: has no calibration .* --psnr-drop needs; adapt it"),
        ("render PLY --images SCENE", "required: -o/--out"),
        ("render PLY --images SCENE -o pictures --sv 0", "--sv has 0"),
        ("render PLY --images nowhere -o pictures", "nowhere: is not a folder"),
        ("render PLY --images SCENE -o text.ply", "text.ply: text.ply is a file; choose another --out"),
        ("render PLY --images SCENE -o SCENE", "the scene's own photographs may be there"),
        ("render PLY --images SCENE -o SCENE/images", "the scene's own photographs may be there"),
        ("render PLY --images SCENE -o pictures --views banana", "--views has 'banana', .* like 000.png, 001.png"),
        ("export DIALLED", "required: -o/--out"),
        ("export DIALLED -o x", "x: --out must end in one of .ply, .*, which says what to write"),
        ("export DIALLED -o .ply --sv 2", ".ply: --out must end in one of"),
        ("export DIALLED -o x.splat", "x.splat: .splat has no room for sigma_d; choose a dial value .* format .*.ply"),
        ("export DIALLED -o x.splat --sv 2 --order extinction", "x.splat: .splat has an order of its own"),
        ("export DIALLED -o dialled.ply --sv 2", "dialled.ply: is an input file"),
        ("export DIALLED -o folder.ply --sv 2", "folder.ply: is a folder"),
        ("export DIALLED -o nowhere/x.glb", "nowhere/x.glb: folder nowhere does not exist"),
        ("export DIALLED -o x.ply --fps 60", "dialled.ply: has no calibration .* --fps needs"),
        ("export DIALLED -o x.ply --sv 2 3", "unrecognized arguments: 3"),
        ("export DIALLED -o x.ply --sv 0.5", "--sv has 0.5, dial values must be"),
        ("export DIALLED -o x.ply --sv 2 --levels 1,2", "--levels has the dial values; give no other"),
        ("export DIALLED -o x.ply --levels 1,4,2", "--levels: '1,4,2' must be rising dial values of at least 1, as in"),
        ("export DIALLED -o x.ply --levels 0,1", "--levels: '0,1' must be"),
        ("export DIALLED -o x.ply --levels nan,2", "--levels: 'nan,2' must be"),
        ("export DIALLED -o x.ply --levels 1,inf", "--levels: '1,inf' must be"),
        ("export DIALLED -o x.ply --levels 1,,2", "--levels: '1,,2' must be"),
        ("export DIALLED -o x --lod-meta", "--lod-meta is a set of levels; give them"),
        ("export DIALLED -o x.ply --lod-meta --levels 1,2", "x.ply: with --lod-meta, --out names the folder"),
        ("export DIALLED -o lod-meta.json --lod-meta --levels 1,2", "--out names the folder that lod-meta.json is to"),
        ("export DIALLED -o x.ply --sv 2 --camera 003", "--camera names a photograph of a scene; give that too"),
        (
            "export DIALLED -o x.ply --images SCENE",
            "--images is for baking, --order and a .html",
        ),
        (
            "export DIALLED -o x.ply --camera 003 --images SCENE",
            "--camera is where a dial value is baked for; give one",
        ),
        ("export DIALLED -o x.ply --sv 2 --camera 003 --images nowhere", "nowhere: is not a folder"),
        (
            "export DIALLED -o x.ply --sv 2 --camera banana --images SCENE",
            "--camera has 'banana', .* like 000.png, 001",
        ),
        ("export PLY -o x.ply --sv 2", "base.ply: has no sigma_d, so there is no dial value to bake"),
        ("export PLY -o x.ply --levels 1,2", "base.ply: has no sigma_d, so there is no dial value to bake"),
        ("export PLY -o x.ply --keep 2", "base.ply: has no sigma_d, so no dial for --keep"),
        ("export PLY -o x.ply --order extinction", "base.ply: has no sigma_d, so there is no order to put its rows in"),
        ("export text.ply -o x.glb", "text.ply: is not a PLY"),
        ("apply PLY missing.safetensors -o x.ply", "missing.safetensors: .*No such file"),
        ("apply PLY text.ply -o x.ply", "text.ply: is not a safetensors file"),
        ("apply mine.ply text.ply -o mine.ply", "mine.ply: is an input file"),
        ("apply PLY text.ply -o text.ply", "text.ply: is an input file"),
        ("apply PLY text.ply -o x.splat", "x.splat: .*must end in .ply"),
    ],
)
@pytest.mark.parametrize("json_too", [False, True])
def test_bad_input(clod: Any, bad: dict[str, Path], tmp_path: Path, line: str, said: str, json_too: bool) -> None:
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    done = clod(*[bad.get(word, word) for word in line.split()], *(["--json"] if json_too else []))
    assert_refused(done, said)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def assert_refused(done: Any, said: str) -> None:
    """Exit code 2, an empty stdout, and one last line on stderr that is the error."""
    assert (done.code, done.out) == (2, ""), done
    errors = [line for line in done.err.splitlines() if "error" in line]
    assert len(errors) == 1 and errors[0] == done.err.splitlines()[-1], done
    assert errors[0].startswith("clod-adapt: error: ") and re.search(said, errors[0]), done


def test_an_error_of_the_system_is_one_line(clod: Any, capture: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device", "some/file")

    monkeypatch.setattr("clod_adapter.cli.evaluate.read_scene", full)
    done = clod("eval", capture.ply, "--images", capture.scene)
    assert_refused(done, "some/file: No space left on device")


def test_bad_input_exits_with_2(spawn: Any, tmp_path: Path) -> None:
    process = spawn("missing.ply", "--images", ".", "--json", cwd=tmp_path)
    out, err = process.communicate(timeout=60)
    assert (process.returncode, out, err.count("\n")) == (2, "", 1)


@pytest.mark.parametrize("command", ["", *COMMANDS])
def test_out_has_a_short_form_wherever_there_is_one(clod: Any, command: str) -> None:
    text = clod(*command.split(), "--help").out
    short = re.search(r"\n  -o[ ,]", text) is not None  # Python 3.13 writes "-o, --out X", 3.12 "-o X, --out X"
    assert ("--out " in text) == short == (command not in ("eval", "inspect", "view", "doctor"))


@pytest.mark.parametrize("command", ["", *COMMANDS])
def test_help(clod: Any, command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    done = clod(*command.split(), "--help")
    assert done.code == 0 and done.out.startswith("usage: clod-adapt") and "--json" in done.out
    assert max(map(len, done.out.splitlines())) <= 80
    if not command:
        assert all(f"clod-adapt {other}" in done.out for other in COMMANDS)
        assert clod("--version").out.split() == ["clod-adapt", package_version()]


@pytest.mark.parametrize(
    ("line", "code"),
    [
        ("--help", 0),
        ("eval --help", 0),
        ("--version", 0),
        ("--nonsense", 2),
        ("missing.ply --images SCENE", 2),
        ("mesh.ply --images SCENE", 2),
        ("PLY --images empty", 2),
        ("PLY --images SCENE --max-sv 0", 2),
        ("PLY --images SCENE --out nowhere/dial.ply", 2),
        ("eval PLY --images SCENE --sv 0", 2),
        ("eval PLY --images SCENE --keep 10", 2),
        ("render --help", 0),
        ("render PLY --images SCENE -o SCENE", 2),
        ("export --help", 0),
        ("export PLY --sv 2 -o x.ply", 2),
        ("export DIALLED --psnr-drop 2 -o x.ply", 2),
        ("export DIALLED -o x.splat", 2),
        ("apply text.ply dial.safetensors -o dial.ply", 2),
    ],
)
def test_help_and_refusals_do_without_torch(bad: dict[str, Path], tmp_path: Path, line: str, code: int) -> None:
    (tmp_path / "mesh.ply").write_text("ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nend_header\n")
    words = [str(bad.get(word, word)) for word in line.split()]
    script = (
        "import sys\n"
        "sys.modules.update(torch=None, pycolmap=None, numba=None)\n"  # importing one is an error
        f"from clod_adapter.cli.main import main; sys.exit(main({words}))"
    )
    done = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == code and "Traceback" not in done.stderr, done.stderr


def test_importing_leaves_the_collector_on() -> None:
    code = (
        "import gc, sys\n"
        "from argparse import Namespace\n"
        "from clod_adapter.cli.main import APPLY, import_command\n"
        "module = import_command(APPLY, Namespace(quiet=True))\n"
        "assert module is import_command(APPLY, Namespace(quiet=True)) and 'torch' in sys.modules\n"
        "assert gc.isenabled() and gc.get_freeze_count() > 1000\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_closed_pipe(spawn: Any, capture: Any, tmp_path: Path) -> None:
    process = spawn("eval", capture.ply, "--images", capture.scene, cwd=tmp_path)
    process.stdout.close()
    assert "Traceback" not in process.stderr.read()
    assert process.wait(timeout=60) == 1


def test_threads_do_not_spin() -> None:
    """The console entry sets OpenMP's waiting policy before torch can read it."""
    code = (
        "import sys, os\n"
        "class Spy:\n"
        "    def find_spec(self, name, *rest):\n"
        "        if name == 'torch': print(os.environ.get('OMP_WAIT_POLICY'))\n"
        "sys.meta_path.insert(0, Spy())\n"
        "import clod_adapter.cli.adapt.run"
    )
    environment = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.split()[0] == "PASSIVE"


def test_ctrl_c_within_compiled_code(clod: Any, capture: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Numba's dispatcher hands it on as a SystemError; other SystemErrors are nobody's Ctrl-C."""
    for cause, code, last in ((KeyboardInterrupt(), 130, "clod-adapt: interrupted"), (None, 1, "please report it")):

        def read(*_: object, cause: BaseException | None = cause) -> None:
            raise SystemError("returned a result with an exception set") from cause

        monkeypatch.setattr("clod_adapter.cli.evaluate.read_checkpoint", read)
        done = clod("eval", capture.ply, "--images", capture.scene)
        assert done.code == code and last in done.err.splitlines()[-1], done


def test_an_unknown_error_is_a_traceback_and_where_to_report_it(
    clod: Any, capture: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise ZeroDivisionError("of ours")

    monkeypatch.setattr("clod_adapter.cli.evaluate.read_checkpoint", fail)
    done = clod("eval", capture.ply, "--images", capture.scene, "--json", "--quiet")
    lines = done.err.splitlines()
    assert done.code == 1 and done.out == "" and lines[0] == "Traceback (most recent call last):", done
    assert lines[-2] == "ZeroDivisionError: of ours" and 'raise ZeroDivisionError("of ours")' in done.err
    assert lines[-1].startswith(f"clod-adapt: error: this is a fault of clod-adapt {package_version()}, not of what")
    assert "please report it, with the lines above" in lines[-1]
