"""Compiled CPU kernels, imported on first use, not by ``import clod_adapter``."""

# gsplat's conventions, for all rasterizers: alpha below which nothing is drawn, largest alpha, and
# the transmittance at which a pixel ends.
ALPHA_MIN = 1 / 255
ALPHA_MAX = 0.999
T_MIN = 1e-4
# Shortest and longest quaternion that is drawn; readers drop others. Its square must fit float32.
QUAT_MIN = 1e-15
QUAT_MAX = 1e15
