"""Stand-ins for several versions of gsplat: modules with their signatures."""

import re
from pathlib import Path
from types import ModuleType

TEXT = Path(__file__).parent / "integrations" / "gsplat_signatures.txt"
FUNCTIONS = (
    "rasterization",
    "rasterization_2dgs",
    "rasterization_inria_wrapper",
    "rasterization_2dgs_inria_wrapper",
)


def signatures():
    """``{version: {function: parameters}}`` as written in the text, without line breaks."""
    parts = re.split(r"^\[(.+)\]$", TEXT.read_text(), flags=re.M)[1:]
    found = {
        version: dict(re.findall(r"^(\w+)\((.*)\)$", text.replace("\n    ", " "), re.M))
        for version, text in zip(parts[::2], parts[1::2], strict=True)
    }
    common = found.pop("every version")
    return {version: common | own for version, own in found.items()}


def module(version, draw=lambda *given: given):
    """The module ``gsplat`` of this version; ``draw`` gets a function's name, the version and the
    arguments.
    """
    made = ModuleType("gsplat")
    made.__version__ = version
    for name, parameters in signatures()[version].items():
        space = {"_draw": draw, "_version": version}
        declared = re.sub(r"=([A-Z]\w+\.\w+)", r"='\1'", parameters)
        exec(f"def {name}({declared}):\n    return _draw({name!r}, _version, locals())", space)
        setattr(made, name, space[name])
    return made
