"""The structure of the package: import order, cost of an import, installed packages."""

import ast
import re
import shutil
import subprocess
import sys
import tomllib
from graphlib import TopologicalSorter
from importlib.util import resolve_name

import pytest
from common import ROOT

PACKAGE = "clod_adapter"

# Lowest first. A unit is a module or package of clod_adapter, of clod_adapter/io, or of cli; it
# imports from rows above its own and from itself, never from beside it.
ORDER = [
    {"_support", "origin"},
    {"errors"},
    {"_kernels", "config"},
    {"cameras"},
    {"quality_table", "frame_rate", "gaussians", "losses"},
    {"equation"},
    {"hook", "progress", "rasterizers"},
    {"adapter", "integrations", "render"},
    {"harmonics", "initialization"},
    {"bake"},
    {"io.atomic", "io.settings"},
    {"io.ranks", "io.values"},
    {"io.file_formats"},
    {"io.ply_layout", "io.scene", "io.tensor_file"},
    {"io.ply"},
    {"io.checkpoint", "io.formats"},
    {"io.adapter_file"},
    {"alignment", "report", "training", "viewer"},
    {"evaluation", "inspection"},
    {"pipeline"},
    {"demo"},
    {""},  # the package itself, whose __init__ re-exports from the rows above
    {"cli.shared"},
    {"cli.view"},
    {
        "cli.adapt",
        "cli.apply",
        "cli.doctor",
        "cli.eval",
        "cli.export",
        "cli.inspect",
        "cli.render",
        "cli.robustness",
    },
    {"cli.demo"},  # runs adapt
    {"cli.main"},
    {"__main__"},
]
LEVELS = {}
for level, units in enumerate(ORDER):
    LEVELS |= dict.fromkeys(units, level)
SOURCES = sorted([*(ROOT / PACKAGE).rglob("*.py"), *(ROOT / "cli").rglob("*.py")])


def module_of(path):
    """Dotted name below the package: ``io.checkpoint``, ``cli.main``, and an empty one for the
    package itself.
    """
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(part for part in parts if part not in (PACKAGE, "__init__"))


MODULES = {module_of(path) for path in SOURCES}


def unit_of(module):
    """``io.formats`` of ``io.formats.spz``, ``training`` of ``training.loop``."""
    parts = module.split(".")
    return ".".join(parts[: 2 if parts[0] in ("io", "cli") else 1])


def imports_of(path):
    """The lines of every import from the package in a file, at any depth, by module (as by
    ``module_of``).
    """
    found = []
    here = f"{PACKAGE}.{module_of(path.parent / '__init__.py')}".rstrip(".")
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            found += [(alias.name, node.lineno) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = resolve_name("." * node.level + (node.module or ""), here)
            for name in (f"{base}.{alias.name}" for alias in node.names):
                # "from clod_adapter import io" names a module, "from clod_adapter import Gaussians"
                # a re-export.
                found.append((name if name.partition(".")[2] in MODULES else base, node.lineno))
    return {
        name.partition(".")[2]: line for name, line in found if name.partition(".")[0] == PACKAGE
    }


def test_imports_fall():
    """No file imports itself by way of others. Its package, whose __init__ runs first, does not
    import it back.
    """
    wrong = []
    graph = {}
    for path in SOURCES:
        module = module_of(path)
        unit = unit_of(module)
        imports = imports_of(path)
        graph[module] = imports.keys() - {module}
        for target, line in imports.items():
            if unit_of(target) != unit and LEVELS[unit_of(target)] >= LEVELS[unit]:
                place = f"{path.relative_to(ROOT)}:{line}"
                wrong.append(f"{place} imports {target}, which is not below it")
    assert not wrong, "\n".join(wrong)
    TopologicalSorter(graph).prepare()  # raises CycleError


STEPS = """
import sys, types, clod_adapter.cli.main
heavy = {"torch", "numpy", "numba", "gsplat", "pycolmap", "plyfile", "matplotlib", "skimage"}
assert not heavy & set(sys.modules)

import numpy, torch

class Installed:
    def find_spec(self, name, path=None, target=None):
        top = name.partition(".")[0]
        if top not in sys.stdlib_module_names and top != "clod_adapter" and top not in sys.modules:
            raise ModuleNotFoundError(name)

sys.path.insert(0, "tests")
import gsplat_versions
sys.meta_path.insert(0, Installed())
inria = types.ModuleType("diff_gaussian_rasterization")
inria.GaussianRasterizationSettings, inria.GaussianRasterizer = tuple, torch.nn.Module
gsplat = gsplat_versions.module("1.4.0", lambda *given: given)
sys.modules |= {"gsplat": gsplat, inria.__name__: inria}
import clod_adapter as clod
import clod_adapter.integrations.inria
from clod_adapter.integrations.gsplat import rasterization

means, ones, eye = torch.rand(5, 3), torch.ones(5), torch.eye(4)
attenuation = clod.AttenuationConfig()
dial = {"sigma_d": ones, "growth_d": ones, "attenuation": attenuation, "virtual_scale": 2}
drawn, keep, growth = clod.Hook(**dial)(means, ones, eye)
quats, K = torch.rand(5, 4), eye[None, :3, :3]
given = rasterization(means, quats, means, ones, means, eye[None], K, 4, 4, **dial)[2]
assert torch.equal(given["opacities"], drawn)
assert torch.equal(given["scales"], means * growth[:, None])
try:
    clod.load("model.ply")
except ModuleNotFoundError as error:
    assert "plyfile" in str(error)

del sys.meta_path[0], sys.modules["gsplat"], sys.modules["diff_gaussian_rasterization"]
import clod_adapter.render, clod_adapter.bake
kinds = {name: type(getattr(clod, name)).__name__ for name in clod.__all__}
assert set(kinds.values()) <= {"type", "EnumType", "function"}, kinds
assert set(clod.__all__) == {name for name in dir(clod) if not name.startswith("_")}
assert not hasattr(clod, "nonsense")
"""


def test_imports_are_light_and_on_first_use():
    """Hook and drop-ins need torch and numpy alone; functions stay functions beside submodules of
    the same name.
    """
    words = [sys.executable, "-c", STEPS]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_every_package_is_installed():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
    packages = {path.parent for path in SOURCES if path.name == "__init__.py"}
    folders = {f"{PACKAGE}.{module_of(path / '__init__.py')}".rstrip(".") for path in packages}
    listed = set(project["tool"]["setuptools"]["packages"])
    assert listed == folders, "list the package in pyproject.toml, [tool.setuptools] packages"
    homeless = [str(path.relative_to(ROOT)) for path in SOURCES if path.parent not in packages]
    assert not homeless, f"in a folder without __init__.py: {homeless}"


def test_no_machine_paths():
    if shutil.which("git") is None or not (ROOT / ".git").exists():
        pytest.skip("not a git checkout, so there is no list of tracked files")
    listing = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    names = subprocess.run(listing, cwd=ROOT, capture_output=True, check=True).stdout.decode()
    files = [ROOT / name for name in names.split("\0") if (ROOT / name).is_file()]
    pattern = re.compile(rb"(?<![\w./~-])/(?:work|root)/")
    naming = [path for path in files if pattern.search(path.read_bytes())]
    assert not naming, f"absolute paths of somebody's machine in {naming}"
