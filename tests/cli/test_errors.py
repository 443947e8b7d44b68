"""Bad input and outputs that would replace something: exit code 2, one line that names it and the
fix, no file changed.

One table for all commands: what is typed, what the line says, and the files that are there before.
"""

import json
import os
import re
import shutil
import subprocess
import sys
from contextlib import contextmanager

import pytest
from PIL import Image

import clod_adapter
from clod_adapter.cli.main import COMMANDS, build_parser, command_of
from clod_adapter.cli.shared.outputs import claimed
from clod_adapter.io.file_formats import WRITABLE, write
from runs import contents


@pytest.fixture(scope="module")
def folder(capture, attenuated, tmp_path_factory):
    """Two scenes, a checkpoint, the files of an adapted one, a dial without quality table, and
    files of other kinds.
    """
    there = tmp_path_factory.mktemp("work")
    shutil.copytree(capture.scene, there / "scene")
    shutil.copytree(capture.scene / "images", there / "nerf" / "images")
    pose = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 5], [0, 0, 0, 1]]
    frames = [{"file_path": f"images/{k:03}", "mask_path": f"masks/{k:03}.png"} for k in range(10)]
    content = {
        "fl_x": 60,
        "w": 64,
        "h": 48,
        "frames": [frame | {"transform_matrix": pose} for frame in frames],
    }
    (there / "nerf" / "transforms.json").write_text(json.dumps(content))
    (there / "nerf" / "masks").mkdir()
    (there / "nerf" / "masks" / "003.png").write_bytes(b"a mask")
    shutil.copy(capture.ply, there / "base.ply")
    for suffix in (".ply", ".safetensors", ".json"):
        shutil.copy(attenuated.with_suffix(suffix), there / f"dial{suffix}")
    bare = clod_adapter.with_dial(capture.gaussians)
    for suffix in WRITABLE:
        write(there / f"bare{suffix}", bare)
    (there / "text.ply").write_text("hello")
    (there / "dial.html").write_text("<title>dial, adaptation report</title>")
    (there / "cut.ply").write_bytes(capture.ply.read_bytes()[:-100])
    (there / "mesh.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nend_header\n"
    )
    for name in ("empty", "out/cells"):
        (there / name).mkdir(parents=True)
    os.mkfifo(there / "pipe.ply")
    return there


@contextmanager
def given(folder, existing):
    """A file of each word: ``NAME`` is foreign, ``NAME>FILE`` a symbolic link, ``NAME~FILE`` a hard
    one.
    """
    made = []
    for word in existing.split():
        name, kind, target = re.fullmatch(r"([^>~]+)([>~]?)(.*)", word).groups()
        made.append(path := folder / name)
        if kind:
            (path.symlink_to if kind == ">" else path.hardlink_to)(folder / target)
        elif name.endswith(".png"):
            Image.new("RGB", (4, 4)).save(path)
        else:
            path.write_bytes(b"foreign")
    yield
    for path in made:
        path.unlink()


TINY = "--images scene --iters 2 --max-sv 2"
ADAPTED = f"base.ply {TINY} --report -o out/dial.ply"
EVAL = "eval dial.ply --images nerf --base base.ply --against base.ply --report page.html"
RENDER = "render dial.ply --images scene -o out"
EXPORT = "export dial.ply --images scene -o"
ROBUSTNESS = f"robustness base.ply {TINY} -o out"
INPUT, BESIDE = "is an input file", "is the adapter, state or report of an input"
FOREIGN = "exists, and clod-adapt did not write it; move it, or choose another output"

ERRORS = [
    # Arguments, and inputs that are none.
    ("--quiet", "arguments are required: PLY .*--help"),
    ("veiw base.ply", "veiw: no such file or command; did you mean clod-adapt view"),
    ("veiw", "veiw: (?!.*did you mean)", "veiw"),
    ("missing.ply --images scene", "missing.ply: .*No such file.*check the path"),
    ("cut.ply --images scene", "cut.ply: .*truncated.*again"),
    (
        "base.ply --images empty",
        "empty: no COLMAP model.*, and no transforms.json; give the folder",
    ),
    ("base.ply --images scene --max-sv 0.5", "--max-sv is 0.5, it must be between 1 and"),
    (
        "base.ply --images scene --with quats --without sh0 quats",
        "--with and --without both name quats",
    ),
    (
        "base.ply --images scene --out nowhere/x.ply",
        "nowhere/x.ply: folder nowhere does not exist; create",
    ),
    (
        "base.ply --images scene --out x.compressed.ply",
        "x.compressed.ply: is written by clod-adapt export alone",
    ),
    ("eval base.ply --images scene --against base.ply base.ply", "base.ply: is given twice"),
    (
        "eval base.ply --images scene --base dial.ply",
        "has a dial; give --base the checkpoint before it, or use --against$",
    ),
    ("eval base.ply --images scene --sv=-0.5 --json", "--sv has -0.5, it must be at least 0"),
    (
        "eval bare.ply --images scene --psnr-drop 1",
        "bare.ply: --psnr-drop: there is no quality table .*; adapt it",
    ),
    (
        "eval dial.ply --images scene --fps 1e7",
        r"--fps 10000000: .*at s = 4, .* a frame takes \S+ ms",
    ),
    (
        "eval base.ply --images scene --report page.txt",
        "page.txt: --report names the page.*end in .html",
    ),
    (
        "render base.ply --images scene -o text.ply",
        "text.ply: text.ply is a file; choose another --out",
    ),
    (
        "render base.ply --images scene -o x --views banana",
        "--views: no photograph is named 'banana'; .* 000.png, 001",
    ),
    *[
        (f"render base.ply --images {scene} -o {out}", "the scene's own photographs may be there")
        for scene, out in (
            ("scene", "scene"),
            ("scene/sparse/0", "scene/images/sub"),
            ("nerf", "nerf"),
            ("nerf", "scene/../nerf/train"),
        )
    ],
    ("export bare.ply -o x", "x: --out must end in one of .ply, .*, which is the format"),
    (
        "export bare.ply -o x.sog",
        "x.sog: .sog cannot store a dial; bake one, .* choose of .*.ply",
    ),
    ("export bare.ply -o x.ply --sv 2 --levels 1,2", "--levels: not allowed with argument --sv"),
    (
        "export bare.ply -o x.spz --exact",
        "--exact is for .html pages; another format has its own precision",
    ),
    (
        "export bare.ply -o x.ply --levels 1,4,2",
        "--levels: '1,4,2' must be ascending dial values of at least 0",
    ),
    (
        "export base.ply -o x --lod-meta",
        "base.ply: has no sigma_d, so no dial values or levels; adapt it first",
    ),
    (
        "export bare.ply -o x --lod-meta --levels 1,2",
        "--lod-meta has levels by distance, no dial value",
    ),
    (
        "export bare.ply -o x.ply --multiplier 2",
        "--multiplier is for --lod-meta and --3dtiles; add one of them",
    ),
    ("export bare.ply -o lod-meta.json --lod-meta", "--out names the folder for lod-meta.json"),
    ("export bare.ply -o . --lod-meta", ".: is the current folder; --out must name a new one"),
    ("export bare.ply base.ply -o x.ply", "2 models are for an .html page; export one at a time"),
    ("export bare.ply base.ply -o x.html --sh-degree 1", "--sh-degree is for one model"),
    ("export bare.ply -o x.ply --sv 2 --camera 003", "--camera needs the scene of the photograph"),
    (
        "export bare.ply -o x.ply --images scene",
        "--images is for baking, --sh-degree and .html",
    ),
    (
        "export bare.ply -o x.ply --sv 2 --tune",
        "--tune is for what is baked for all cameras",
    ),
    ("apply bare.ply dial.safetensors -o x.ply", "bare.ply: a different base was given"),
    ("apply base.ply dial.safetensors -o pipe.ply", "pipe.ply: is no regular file"),
    ("view empty", "empty: has no splat in it; give the file"),
    ("view base.ply --port 65536", "--port is 65536, it must be between 1 and 65535"),
    (
        "view bare.ply --device-preset phone",
        "bare.ply: stores no cameras, which --device-preset needs; give",
    ),
    ("demo -o base.ply/here", "base.ply/here: base.ply is a file; choose another --out"),
    # Inputs: checkpoints, adapters, photographs, masks, files of a COLMAP model; by hard and
    # symbolic links.
    ("base.ply --images scene --out base.ply", "base.ply: is an input file.*choose another"),
    (
        ADAPTED,
        rf"out/dial.ply: {INPUT} \(base.ply\), which is never overwritten",
        "out/dial.ply~base.ply",
    ),
    (
        ADAPTED,
        rf"out/dial.safetensors: {INPUT} \(scene",
        "out/dial.safetensors>scene/images/004.png",
    ),
    (
        "base.ply --images nerf --max-sv 2 -o nerf/transforms.ply",
        f"nerf/transforms.json: {INPUT}, which",
    ),
    (EVAL, rf"page.html: {INPUT} \(nerf", "page.html~nerf/masks/003.png"),
    (RENDER, rf"out/008.png: {INPUT} \(scene", "out/008.png>scene/images/000.png"),
    (
        f"{EXPORT} x.ply --levels 1,2",
        rf"x_s2.ply: {INPUT} \(scene",
        "x_s2.ply~scene/images/000.png",
    ),
    ("export dial.ply -o y.spz", rf"y.spz: {INPUT} \(dial.ply\)", "y.spz~dial.ply"),
    (
        "apply base.ply dial.safetensors -o x.ply",
        rf"x.ply: {INPUT} \(dial.safet",
        "x.ply~dial.safetensors",
    ),
    (
        ROBUSTNESS,
        rf"out/cells/base_base.json: {INPUT} \(base.ply\)",
        "out/cells/base_base.json~base.ply",
    ),
    # Files of adapting beside the input, which are named for something else.
    (
        "export link.ply -o dial.html",
        f"dial.html: {BESIDE}",
        "link.ply>dial.ply",
    ),
    # Names that follow from others, where a file is that another program wrote.
    (f"base.ply {TINY} -o out.ply", f"out.json: {FOREIGN}", "out.json"),
    (f"base.ply {TINY} --report -o out.ply", f"out_rendering.png: {FOREIGN}", "out_rendering.png"),
    (f"base.ply {TINY}", f"base_clod.ply: {FOREIGN}", "base_clod.ply"),
    (f"{EXPORT} x.spz --levels 1,2", f"x_s1.spz: {FOREIGN}", "x_s1.spz"),
    ("export dial.ply -o nerf --3dtiles", "nerf: is a folder that is not empty"),
    (ROBUSTNESS, f"out/cells/base_sv2.safetensors: {FOREIGN}", "out/cells/base_sv2.safetensors"),
    ("demo -o out", f"out/curve.png: {FOREIGN}", "out/curve.png"),
]


@pytest.mark.parametrize("line, said, existing", [(*row, "")[:3] for row in ERRORS])
def test_errors(run_in, folder, line, said, existing):
    """The line is the last one of stderr; with --json also the one object on stdout."""
    with given(folder, existing):
        refused(run_in, folder, said, line)


def refused(run_in, folder, said, line):
    before = contents(folder)
    done = run_in(folder, line, code=2)
    (error,) = (each for each in done.err.splitlines() if "error" in each)
    why = error.removeprefix("clod-adapt: error: ")
    assert done.err.endswith(f"{error}\n") and why != error and re.search(said, why)
    assert (done.report == {"error": why, "code": 2}) if "--json" in line else done.out == ""
    assert contents(folder) == before


def outputs_of(line):
    words = line.split()
    name = words[0] if words[0] in COMMANDS else ""
    return command_of(name).outputs(build_parser(name).parse_args(words[1:] if name else words))


@pytest.mark.parametrize(
    "first, second, said",
    [
        (f"base.ply {TINY} -o two.ply", "export dial.ply -o two.ply", "two.ply"),
        (
            f"base.ply {TINY} -o two.ply --report",
            "eval dial.ply --images scene --report two.html",
            "two.html",
        ),
        ("export dial.ply -o x.ply --levels 1,2", "export dial.ply -o x_s2.ply", "x_s2.ply"),
        (RENDER, RENDER, "out"),
        ("export dial.ply -o two.ply", "export dial.ply -o two.spz", ""),
    ],
)
def test_two_runs_at_once(run_in, folder, monkeypatch, first, second, said):
    monkeypatch.chdir(folder)
    with claimed(outputs_of(first)):
        if said:
            refused(run_in, folder, rf"^{said}: another run is writing it; wait for that", second)
        else:
            with claimed(outputs_of(second)):
                pass


def test_earlier_outputs_are_replaced(clod, attenuated, tmp_path):
    """And a foreign file, if the command line names it."""
    for suffix in (".safetensors", ".json"):
        shutil.copy(attenuated.with_suffix(suffix), tmp_path / f"out{suffix}")
    (tmp_path / "out.ply").write_bytes(b"foreign, but named")
    twice = (
        "render DIAL --images SCENE -o pictures",
        "export DIAL -o x.pt",
        "export DIAL -o x.spz --levels 1,2",
    )
    for line in ("BASE --images SCENE --iters 2 --max-sv 2 -o out.ply", *twice, *twice):
        clod(line, "--quiet")


LIGHT = """
--help | eval --help | --version | --nonsense | missing.ply --images scene | mesh.ply --images scene
base.ply --images scene --out nowhere/dial.ply | eval base.ply --images scene --keep 10
render base.ply --images scene
apply text.ply dial.safetensors -o dial.ply | inspect base.ply
view base.ply --device-preset phone
"""


def test_help_errors_and_inspect_do_not_import_torch(folder):
    """``--help`` not even numpy, which takes 0.1 s. Idle threads of OpenMP are set to wait before
    torch reads that.
    """
    lines = [line.split() for line in LIGHT.replace("\n", " | ").split(" | ") if line]
    lines += [["eval", f"bare{suffix}", "--images", "empty"] for suffix in WRITABLE]
    script = (
        "import json, os, sys, clod_adapter\n"
        "sys.modules.update(torch=None, pycolmap=None, numba=None)\n"  # importing one is an error
        "from clod_adapter.cli.main import main\n"
        "def code(words):\n"
        "    try: return main(words)\n"
        "    except SystemExit as done: return done.code or 0\n"
        "code(['--help'])\n"
        "assert 'numpy' not in sys.modules and os.environ['OMP_WAIT_POLICY'] == 'PASSIVE'\n"
        "print(json.dumps([code(words) for words in json.loads(sys.argv[1])]))\n"
    )
    words = [sys.executable, "-c", script, json.dumps(lines)]
    environment = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
    done = subprocess.run(words, cwd=folder, env=environment, capture_output=True, text=True)
    wanted = [
        0 if line[-1] in ("--help", "--version") or line[0] == "inspect" else 2 for line in lines
    ]
    assert done.returncode == 0
    assert "Traceback" not in done.stderr
    assert json.loads(done.stdout.splitlines()[-1]) == wanted
