"""Bad input: one line, exit code 2, before torch is imported."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import clod_adapter
from clod_adapter.cli.render import check_folder
from clod_adapter.cli.shared.command import check_scene
from clod_adapter.errors import ClodError
from photographs import model_of


@pytest.fixture
def scenes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder, the current one, with a COLMAP scene and one of transforms."""
    model_of(tmp_path / "colmap", "PINHOLE", [33, 33, 20, 15])
    (tmp_path / "colmap" / "images").mkdir()
    (tmp_path / "nerf").mkdir()
    (tmp_path / "nerf" / "transforms.json").write_text("{}")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("scene", ["colmap", "colmap/sparse/0", "colmap/images", "nerf"])
def test_scene_folders(scenes: Path, scene: str) -> None:
    check_scene(scene)
    check_folder(Path("out"), Path(scene))
    check_folder(Path("colmap/renders"), Path(scene))


def test_folders_without_a_scene(scenes: Path) -> None:
    (scenes / "empty").mkdir()
    with pytest.raises(ClodError, match="empty: no COLMAP model .*, and no transforms.json; give"):
        check_scene("empty")
    with pytest.raises(ClodError, match="nerf/transforms.json: is not a folder"):
        check_scene("nerf/transforms.json")


@pytest.mark.parametrize(
    ("scene", "out"),
    [
        ("colmap", "colmap"), ("colmap", "colmap/images"), ("colmap", "colmap/images_4/out"),
        ("colmap", "colmap/input"), ("colmap/sparse/0", "colmap/images/sub"), ("colmap/images", "colmap/images/sub"),
        ("nerf", "nerf"), ("nerf", "nerf/train"), ("nerf", "colmap/../nerf/train"),
    ],
)  # fmt: skip
def test_folders_of_photographs_are_refused_as_output(scenes: Path, scene: str, out: str) -> None:
    with pytest.raises(ClodError, match="the scene's own photographs may be there"):
        check_folder(Path(out), Path(scene))


@pytest.fixture
def bad(tmp_path: Path, capture: Any) -> dict[str, Path]:
    """Arguments of wrong commands."""
    for name in ("text.ply", "broken.safetensors", "a.hier", "a.lcc", "a.ckpt"):
        (tmp_path / name).write_text("hello")
    (tmp_path / "empty").mkdir()
    (tmp_path / "cut.ply").write_bytes(capture.ply.read_bytes()[:-100])
    (tmp_path / "mine.ply").write_bytes(capture.ply.read_bytes())
    (tmp_path / "folder.ply").mkdir()
    for suffix in (".ply", ".glb"):
        clod_adapter.save(tmp_path / f"dialled{suffix}", clod_adapter.with_dial(capture.gaussians))
    scene = capture.scene
    return {"PLY": capture.ply, "SCENE": scene, "SCENE/images": scene / "images", "DIALLED": Path("dialled.ply")}


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("", "arguments are required: PLY .*--help"),
        ("missing.ply --images SCENE", "missing.ply: .*No such file.*check the path"),
        ("text.ply --images SCENE --json", "text.ply: is not a PLY.*convert"),
        ("cut.ply --images SCENE", "cut.ply: .*truncated.*again"),
        ("a.hier --out dial.ply", "Hierarchical-3DGS"),
        ("a.lcc --out dial.ply", "splat-transform"),
        ("a.ckpt --out dial.ply", "ns-export"),
        ("PLY --images nowhere", "nowhere: is not a folder; give"),
        ("PLY --images empty", "empty: no COLMAP model.*give the folder"),
        ("veiw PLY", "veiw: no such file or command; did you mean clod-adapt view"),
        ("evla PLY --images SCENE --json", "did you mean clod-adapt eval"),
        ("PLY --images SCENE --max-sv 0.5", "--max-sv is 0.5, it must be at least 1"),
        ("PLY --images SCENE --max-sv nan", "--max-sv is nan"),
        ("PLY --images SCENE --max-sv 300", "--max-sv is 300, it must be below 50"),
        ("PLY --images SCENE --iters -1", "--iters is -1, it must be at least 0"),
        ("PLY --images SCENE --seed -1", "--seed is -1, it must be at least 0"),
        ("PLY --images SCENE --time-budget 0", "--time-budget is 0.0, it must be positive"),
        ("PLY --images SCENE --time-budget inf", "--time-budget is inf, it must be"),
        ("PLY --images SCENE --with colour", "--with: invalid choice: 'colour' .*bands.*unseen.*means.*sh0"),
        ("PLY --images SCENE --with quats --without sh0 quats", "--with and --without both name quats"),
        ("PLY --images SCENE --out nowhere/dial.ply", "nowhere/dial.ply: folder nowhere does not exist; create"),
        ("PLY --images SCENE --out dial.splat", "dial.splat: .*must end in .ply"),
        ("PLY --images SCENE --out a.compressed.ply", "a.compressed.ply: is written by clod-adapt export alone"),
        ("PLY --images SCENE --out folder.ply", "folder.ply: is a folder"),
        ("mine.ply --images SCENE --out mine.ply", "mine.ply: is an input file.*choose another"),
        ("eval missing.ply --images SCENE", "missing.ply: .*check the path"),
        ("eval PLY --images SCENE --against PLY text.ply", "text.ply: is not a PLY"),
        ("eval PLY --images SCENE --base missing.ply", "missing.ply: .*check the path"),
        ("eval PLY --images SCENE --sv=-0.5", "--sv has -0.5, it must be at least 0"),
        ("eval PLY --images SCENE --sv", "--sv: expected at least one argument.*clod-adapt eval --help"),
        ("eval PLY --images SCENE --keep 10", "base.ply: has no sigma_d, which --keep needs; adapt it first"),
        ("eval PLY --images SCENE --keep 0 --json", "--keep has 0, it must be positive"),
        ("eval PLY --images SCENE --fps nan", "--fps has nan, it must be positive"),
        ("eval PLY --images SCENE --psnr-drop -1", "--psnr-drop has -1, it must be positive"),
        ("eval PLY --images SCENE --sv 2 --keep 10", "--keep: not allowed with argument --sv"),
        ("eval DIALLED --images SCENE --psnr-drop 1", "dialled.ply: has no calibration .* --psnr-drop needs; adapt it"),
        ("render PLY --images SCENE --json", "required: -o/--out"),
        ("render PLY --images SCENE -o pictures --sv=-1", "--sv has -1"),
        ("render PLY --images nowhere -o pictures", "nowhere: is not a folder"),
        ("render PLY --images SCENE -o text.ply", "text.ply: text.ply is a file; choose another --out"),
        ("render PLY --images SCENE -o SCENE", "the scene's own photographs may be there"),
        ("render PLY --images SCENE -o x --views banana", "--views: no photograph is named 'banana'; .* 000.png, 001"),
        ("export DIALLED", "required: -o/--out"),
        ("export DIALLED -o x", "x: --out must end in one of .ply, .*, which is the format"),
        ("export DIALLED -o .ply --sv 2", ".ply: --out must end in one of"),
        ("export DIALLED -o x.splat", "x.splat: .splat cannot store a dial; choose a dial value .* format .*.ply"),
        ("export DIALLED -o x.splat --sv 2 --order extinction", "x.splat: .splat sorts the Gaussians itself"),
        ("export DIALLED -o dialled.ply --sv 2 --json", "dialled.ply: is an input file"),
        ("export DIALLED -o folder.ply --sv 2", "folder.ply: is a folder"),
        ("export DIALLED -o nowhere/x.glb", "nowhere/x.glb: folder nowhere does not exist"),
        ("export DIALLED -o x.ply --fps 60", "dialled.ply: has no calibration .* --fps needs"),
        ("export DIALLED -o x.ply --sv=-0.5", "--sv has -0.5, it must be"),
        ("export DIALLED -o . --lod-meta --levels 1,2", ".: is the current folder; --out must name a new one"),
        ("export DIALLED -o x --lod-meta --levels 1,2 --order extinction", "--lod-meta sorts the Gaussians itself"),
        ("export DIALLED -o x.ply --sv 2 --levels 1,2", "--levels gives the dial values; give no other"),
        ("export DIALLED -o page.html --levels 1,2", "remove --levels, --camera and --order"),
        ("export DIALLED -o page.html --order extinction", "remove --levels, --camera and --order"),
        ("export DIALLED -o x.ply --levels 1,4,2", "--levels: '1,4,2' must be ascending dial values of at least 0"),
        ("export DIALLED -o x.ply --levels nan,2", "--levels: 'nan,2' must be"),
        ("export DIALLED -o x.ply --levels 1,inf", "--levels: '1,inf' must be"),
        ("export DIALLED -o x --lod-meta", "--lod-meta needs several levels; give them"),
        ("export DIALLED -o x.ply --lod-meta --levels 1,2", "x.ply: with --lod-meta, --out names the folder"),
        ("export DIALLED -o lod-meta.json --lod-meta --levels 1,2", "--out names the folder for lod-meta.json"),
        ("export DIALLED -o x --3dtiles --levels 2", "--3dtiles needs several levels; give them"),
        ("export DIALLED -o x --3dtiles --lod-meta --levels 1,2", "write a folder each; give one of them"),
        ("export DIALLED -o x --3dtiles --levels 1,2 --order extinction", "--3dtiles sorts the Gaussians itself"),
        ("export DIALLED -o x.glb --3dtiles --levels 1,2", "x.glb: with --3dtiles, --out names the folder for tileset"),
        ("export DIALLED -o x.ply --sv 2 --camera 003", "--camera needs the scene of the photograph"),
        ("export DIALLED -o x.ply --images SCENE", "--images is used for baking, --order and .html"),
        ("export DIALLED -o x.ply --camera 003 --images SCENE", "--camera needs a dial value to bake; give one"),
        ("export DIALLED -o x.ply --sv 2 --camera 003 --images nowhere", "nowhere: is not a folder"),
        ("export DIALLED -o x.ply --sv 2 --camera no --images SCENE", "--camera: no photograph is named 'no'; .* 000"),
        ("export PLY -o x.ply --sv 2", "base.ply: has no sigma_d, so no dial value can be baked"),
        ("export PLY -o x.ply --levels 1,2", "base.ply: has no sigma_d, so no dial value can be baked"),
        ("export PLY -o x.ply --keep 2", "base.ply: has no sigma_d, which --keep needs"),
        ("export PLY -o x.ply --order extinction", "base.ply: has no sigma_d to order its Gaussians by"),
        ("export text.ply -o x.glb", "text.ply: is not a PLY"),
        ("apply PLY missing.safetensors -o x.ply", "missing.safetensors: .*No such file"),
        ("apply PLY text.ply -o x.ply --json", "text.ply: is not a safetensors file"),
        ("apply mine.ply text.ply -o mine.ply", "mine.ply: is an input file"),
        ("apply PLY text.ply -o x.splat", "x.splat: .*must end in .ply"),
        ("eval DIALLED --images SCENE --base DIALLED", "has a dial .*; give --base the checkpoint.* --against$"),
        ("eval PLY --images SCENE --report page.txt", "page.txt: --report names the page.*end in .html"),
        ("eval PLY --images SCENE --report no/page.html", "no/page.html: folder no does not exist"),
        ("inspect missing.ply", "missing.ply: "),
        ("inspect cut.ply --json", "cut.ply: "),
        ("inspect broken.safetensors", "broken.safetensors: "),
        ("view missing.ply", "missing.ply: .*check the path"),
        ("view PLY --base text.ply", "text.ply: is not a PLY"),
        ("view PLY --images nowhere", "nowhere: is not a folder"),
        ("view PLY --port 65536", "--port is 65536, it must be between 1 and 65535"),
        ("view DIALLED --device-preset phone", "dialled.ply: stores no cameras, which --device-preset needs; give"),
        ("view dialled.glb --device-preset phone", "dialled.glb: stores no cameras, which --device-preset needs"),
        ("view PLY --sv=-0.5", "--sv is -0.5, it must be at least 0"),
        ("robustness PLY PLY --images SCENE", "base.ply: is given twice"),
        ("robustness PLY --images SCENE --max-sv 1 0.5", "--max-sv is 0.5, it must be at least 1"),
        ("robustness PLY missing.ply --images SCENE", "missing.ply: .*check the path"),
        ("robustness PLY --images SCENE --out text.ply", "text.ply: text.ply is a file; choose another --out"),
        ("robustness PLY --images nowhere", "nowhere: is not a folder"),
    ],
)  # fmt: skip
def test_bad_input(clod: Any, bad: dict[str, Path], tmp_path: Path, line: str, said: str) -> None:
    """Exit code 2, the error as the last line of stderr, with --json in the one object on stdout, unchanged files."""
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    done = clod(*[bad.get(word, word) for word in line.split()])
    errors = [line for line in done.err.splitlines() if "error" in line]
    assert done.code == 2 and len(errors) == 1 and errors[0] == done.err.splitlines()[-1], done
    assert errors[0].startswith("clod-adapt: error: ") and re.search(said, errors[0]), done
    why = errors[0].removeprefix("clod-adapt: error: ")
    assert (json.loads(done.out) == {"error": why, "code": 2}) if "--json" in line else done.out == "", done
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


LINES = """
--help | eval --help | --version | render --help | export --help
--nonsense | missing.ply --images SCENE | mesh.ply --images SCENE | PLY --images empty
PLY --images SCENE --max-sv 0 | PLY --images SCENE --out nowhere/dial.ply
eval PLY --images SCENE --sv=-1 | eval PLY --images SCENE --keep 10 | render PLY --images SCENE -o SCENE
export PLY --sv 2 -o x.ply | export DIALLED --psnr-drop 2 -o x.ply | export DIALLED -o x.splat
apply text.ply dial.safetensors -o dial.ply | inspect PLY
view DIALLED DIALLED --device-preset phone | export PLY --device-preset phone -o x.ply
"""


def test_help_errors_and_inspect_do_not_import_torch(bad: dict[str, Path], tmp_path: Path) -> None:
    (tmp_path / "mesh.ply").write_text("ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nend_header\n")
    lines = [line.split() for line in LINES.replace("\n", " | ").split(" | ") if line]
    script = (
        "import json, sys\n"
        "sys.modules.update(torch=None, pycolmap=None, numba=None)\n"  # importing one is an error
        "from clod_adapter.cli.main import main\n"
        "def code(words):\n"
        "    try: return main(words)\n"
        "    except SystemExit as done: return done.code or 0\n"
        "codes = [code(words) for words in json.loads(sys.argv[1])]\n"
        "print(json.dumps(codes)); sys.exit(code(['--nonsense']))"
    )
    words = json.dumps([[str(bad.get(word, word)) for word in line] for line in lines])
    done = subprocess.run([sys.executable, "-c", script, words], cwd=tmp_path, capture_output=True, text=True)
    wanted = [0 if line[-1] in ("--help", "--version") or line[0] == "inspect" else 2 for line in lines]
    assert "Traceback" not in done.stderr and json.loads(done.stdout.splitlines()[-1]) == wanted, done
    assert done.returncode == 2 and len(lines) == 21
