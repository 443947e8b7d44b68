"""The shape of the house: what may import what, what an import costs, what gets installed."""

from __future__ import annotations

import ast
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = "clod_adapter"

# Lowest first. A module may import from lower floors, and from its own unless the floor is in SEPARATE.
FLOORS = [
    {"errors", "_lazy", "fusing", "text", "workers"},
    {"_kernels"},
    {
        "config",
        "calibration",
        "gaussians",
        "cameras",
        "attenuation",
        "collapse",
        "counting",
        "extinction",
        "finite",
        "hook",
        "losses",
        "metrics",
        "optimizer",
        "perceptual",
        "training_state",
        "units",
        "viewpoints",
    },
    {"io", "rasterizers", "adapter"},
    {"render"},
    {
        "importance",
        "popping",
        "budget",
        "placement",
        "alignment",
        "alignment_frames",
        "alignment_guess",
        "antialiasing",
    },
    {"inspection", "inspection_tensors", "inspection_values", "objective", "distributed", "drawing", "needs"},
    {"train", "evaluate", "export", "viewer", "compare"},
    {"report", "robustness", "integrations", "plan", "planning", "chunks", "chunks_aims", "chunks_division", "memory"},
    {"demo"},
    {""},  # the package itself, whose __init__ re-exports from all of the above
    {"cli", "__main__"},
]
SEPARATE = [7]  # train, evaluate, export, ... do not import each other
SOURCES = sorted([*(ROOT / PACKAGE).rglob("*.py"), *(ROOT / "cli").rglob("*.py")])


def module_of(path: Path) -> tuple[str, ...]:
    """Dotted parts below the package: ``("io", "ply")``, ``("cli", "main")``, ``()`` for the package itself."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    parts = parts[1:] if parts[0] == PACKAGE else parts
    return parts[:-1] if parts[-1] == "__init__" else parts


MODULES = {module_of(path) for path in SOURCES}


def floor_of(name: str) -> int:
    for level, names in enumerate(FLOORS):
        if name in names:
            return level
    pytest.fail(f"{PACKAGE}.{name} has no floor: place it in FLOORS of {Path(__file__).name}")


def imports_of(path: Path, tree: ast.AST) -> list[tuple[int, str]]:
    """Line and top name below the package of everything that a file imports from it, at any depth."""
    found = []
    for node in ast.walk(tree):
        targets: list[str] = []
        if isinstance(node, ast.Import):
            targets = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                here = (PACKAGE, *module_of(path))
                cut = node.level - (path.name == "__init__.py")
                base = ".".join((*here[: len(here) - cut], *([base] if base else [])))
            # "from clod_adapter import io" names a module, "from clod_adapter import Gaussians" a re-export.
            below = {(alias.name,) for alias in node.names} & MODULES if base == PACKAGE else set()
            targets = [f"{PACKAGE}.{parts[0]}" for parts in below]
            if base != PACKAGE or len(below) < len(node.names):
                targets.append(base)
        for target in targets:
            head, *rest = target.split(".")
            if head == PACKAGE:
                found.append((node.lineno, rest[0] if rest else ""))
            elif head == "cli":
                found.append((node.lineno, "cli"))
    return found


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_go_down_only(path: Path) -> None:
    name = (module_of(path) or ("",))[0]
    own = floor_of(name)
    for line, target in imports_of(path, ast.parse(path.read_text(encoding="utf-8"))):
        level = floor_of(target)
        allowed = target == name or level < own or (level == own and own not in SEPARATE)
        assert allowed, f"{path.relative_to(ROOT)}:{line} imports {PACKAGE}.{target}, which is not below it"


@pytest.mark.parametrize(
    ("where", "source", "want"),
    [
        ("render.py", "from clod_adapter.io.ply import read", ["io"]),
        ("render.py", "def f():\n    import clod_adapter.adapter as a", ["adapter"]),
        (
            "render.py",
            "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from .cameras import Camera",
            ["cameras"],
        ),
        (
            "io/ply.py",
            "from . import atomic\nfrom .. import cameras\nfrom ..errors import ClodError",
            ["io", "cameras", "errors"],
        ),
        ("io/__init__.py", "from .ply import read", ["io"]),
        ("render.py", "from clod_adapter import Gaussians, config", ["config", ""]),
        ("render.py", "import torch, cli.main", ["cli"]),
    ],
)
def test_every_way_of_importing_is_seen(where: str, source: str, want: list[str]) -> None:
    assert [target for _, target in imports_of(ROOT / PACKAGE / where, ast.parse(source))] == want


def test_package_only_re_exports() -> None:
    tree = ast.parse((ROOT / PACKAGE / "__init__.py").read_text(encoding="utf-8"))
    defined = [n.name for n in ast.walk(tree) if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef)]
    assert set(defined) <= {"__getattr__", "__dir__"}, f"{PACKAGE}/__init__.py defines {defined}"


def test_import_is_light(tmp_path: Path) -> None:
    heavy = ["torch", "numpy", "numba", "gsplat", "pycolmap", "plyfile", "matplotlib", "skimage"]
    code = f"import sys, {PACKAGE}; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_names_of_the_package(tmp_path: Path) -> None:
    """They are imported on first use, and functions stay functions where a submodule has the same name."""
    code = (
        f"import {PACKAGE} as package, {PACKAGE}.render, {PACKAGE}.evaluate\n"
        "kinds = {name: type(getattr(package, name)).__name__ for name in package.__all__}\n"
        "assert set(kinds.values()) == {'type', 'function'}, kinds\n"
        "assert set(package.__all__) <= set(dir(package))\n"
        "assert not hasattr(package, 'nonsense')\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_every_package_is_installed() -> None:
    listed = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["setuptools"]["packages"]
    folders = {".".join((PACKAGE, *module_of(path))) for path in SOURCES if path.name == "__init__.py"}
    assert set(listed) == folders, "list the package in pyproject.toml, [tool.setuptools] packages"
    homeless = [str(p.relative_to(ROOT)) for p in SOURCES if not (p.parent / "__init__.py").exists()]
    assert not homeless, f"in a folder without __init__.py: {homeless}"


def test_no_machine_paths() -> None:
    if shutil.which("git") is None or not (ROOT / ".git").exists():
        pytest.skip("not a git checkout, so there is no list of tracked files")
    listing = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    files = subprocess.run(listing, cwd=ROOT, capture_output=True, check=True).stdout.decode().split("\0")
    pattern = re.compile(rb"(?<![\w./~-])/(?:work|root)/")
    found = [name for name in files if name and (ROOT / name).is_file() and pattern.search((ROOT / name).read_bytes())]
    assert not found, f"absolute paths of somebody's machine in {found}"
