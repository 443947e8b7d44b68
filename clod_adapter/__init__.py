"""A quality dial for Gaussian splats that are already trained.

import clod_adapter as clod
base = clod.load("pretrained.ply")
scene = clod.load_scene("scene/", origin=base.origin)
result = clod.adapt_checkpoint(base, scene, clod.AdaptConfig(max_sv=5))
result.save("model.ply")
image = clod.render(result.gaussians, scene.test[0].camera, virtual_scale=3).image
"""

import os
import sys

import lazy_loader

if "torch" not in sys.modules:
    # GNU OpenMP's idle threads spin by default and take the cores from the splatting threads:
    # measured at up to six times the time of a training step. Only the first import of torch reads
    # this.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

# Imported on first use: torch takes a second or two, which the command's --help and most of its
# errors do without. The names are in __init__.pyi.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
