"""Constants of gsplat's conventions, the kernels' arguments, and the layouts of records and
workspaces.
"""

from typing import Any, NamedTuple

from numba import float32

import clod_adapter._kernels as limits

ALPHA_MIN = float32(limits.ALPHA_MIN)
ALPHA_MAX = float32(limits.ALPHA_MAX)
T_MIN = float32(limits.T_MIN)
QUAT_MIN2 = float32(limits.QUAT_MIN**2)
QUAT_MAX2 = float32(limits.QUAT_MAX**2)
LOG2E = float32(1.4426950408889634)
LOG2_255 = float32(7.994353436858858)
TWO_LN2 = float32(1.3862943611198906)
HUGE = float32(3e38)  # larger values are dropped as not finite

# Columns of a record, the 64 bytes the blending loops read of a visible Gaussian. The exponent of
# its alpha is in powers of two: log2 alpha = LOG - (QA dx^2 + QB dx dy + QC dy^2).
MX = 0
MY = 1
QA = 2
QB = 3
QC = 4
LOG = 5
RED = 6
GREEN = 7
BLUE = 8
REACH = 9
RX = 10
DET = 11
X0 = 12
Y0 = 13
X1 = 14
Y1 = 15
RECORD = 16

# The workspace of sixteen Gaussians: vectors with one lane per Gaussian. As stored: mean (3),
# quaternion (4), scales (3). Then camera point (3), rotation (9), U = J R_view (6), P = U R S (6),
# blurred covariance (3), its determinant, unit quaternion (4), 1 / |quaternion|, determinant of P
# P^T.
MEAN = 0
STORED = 3
SCALE = 7
POINT = 10
ROT = 13
UMAT = 22
PMAT = 28
COV = 34
COVDET = 37
QUAT = 38
QINV = 42
RAWDET = 43
WORKSPACE = 44 + 16  # load_rows always fills sixteen vectors

TILE = 64  # pixels: sixteen blocks of four
# Extents are widened by this many pixels against rounding at the 1/255 edge.
SLACK = float32(0.01)
# Sums over pixels per pair of Gaussian and tile, for the projection's gradient.
PAIR = 9
# Records are prefetched this many entries ahead.
AHEAD = 4

# Gradients of sixteen Gaussians as vectors: sums over pixels (9), P (6), rotation matrix (9), then
# what is stored: scales (3), quaternion (4), mean (3), SH degree 0 (3).
SUMS = 0
V_P = 9
V_ROT = 15
V_SCALE = 24
V_QUAT = 27
V_MEAN = 31
V_SH0 = 34
GRADIENTS = 37 + 16


class Stored(NamedTuple):
    """Arrays of N Gaussians, or their gradients, in the order of the rasterizer's inputs.

    ``sigma`` is empty without a dial, ``growth`` without growth. Scales and opacities are
    logarithms and logits as stored, or activated ones, as the dial says.
    """

    means: Any  # [N, 3]
    quats: Any  # [N, 4]
    scales: Any  # [N, 3]
    opacities: Any  # [N]
    sigma: Any  # [N]
    growth: Any  # [N]
    sh0: Any  # [N, 1, 3]
    shN: Any  # [N, K - 1, 3]


class Dial(NamedTuple):
    """A dial value s and its equation, in float32."""

    rate2: Any = float32(0)  # (s / D)^2, 1 / world units^2
    growth_rate2: Any = float32(0)  # (s / (D r))^2, likewise
    near2: Any = float32(0)  # 1 / H^2; 0 without near Gaussians
    activated: bool = False  # scales and opacities are activated, and there is no dial


class Drawing(NamedTuple):
    """Settings by which Gaussians are drawn. Numbers are float32, lengths on the image pixels."""

    viewmat: Any  # flat, row-major
    eye: Any  # [3] the camera's centre, in the world
    fx: Any
    fy: Any
    cx: Any
    cy: Any
    width: Any
    height: Any
    low_x: Any  # clamp of the ray
    high_x: Any
    low_y: Any
    high_y: Any
    near: Any  # the near plane
    blur: Any  # the screen-space filter's variance
    compensate: bool  # opacities are compensated for it
    dial: Dial
    degree: int = 0  # of the spherical harmonics
    fades: bool = False  # there is a sigma
    grows: bool = False  # there is a growth


class Packed(NamedTuple):
    """The visible Gaussians: worker w packed ``counts[w]`` of them, from the first row of its part
    of the N rows on, in row order.
    """

    records: Any  # flat, RECORD N, then a spare record for each worker
    depths: Any  # [N] float32
    ids: Any  # [N] int32, the rows
    counts: Any  # [workers] int64


class Tiles(NamedTuple):
    """The tiles of an image, and the records that each blends, front to back."""

    records: Any
    entries: Any  # [M] int32, numbers of records
    offsets: Any  # [tiles + 1] int64: those of tile t are from ``offsets[t]`` on
    masks: Any  # [M, WORDS] uint64: a bit for each block of the tile that blends the entry
    order: Any  # [tiles] int64, the order of work
    across: int  # tiles in a row
    width: int  # pixels
    height: int


class Picture(NamedTuple):
    """An image and its alpha, or their gradients."""

    image: Any  # [H, W, 3]
    alpha: Any  # [H, W]
