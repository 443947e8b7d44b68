"""Cameras that are no pinholes are refused."""

import math

import pytest
import torch
from refusals import refused

from clod_adapter import Camera
from clod_adapter.cameras import intrinsics

VIEWMAT = torch.eye(4)
K = intrinsics(60.0, 60, 32, 24)


def changed(matrix, row, column, value):
    found = matrix.clone()
    found[row, column] = value
    return found


@pytest.mark.parametrize(
    "given, message",
    [
        ({"viewmat": "a"}, "viewmat is 'a', it must be an array of numbers"),
        ({"viewmat": [[1], [1, 2]]}, "must be an array of numbers"),
        ({"viewmat": torch.eye(3)}, "needs viewmat"),
        ({"width": 64.0}, "has size 64.0x48; give whole numbers"),
        ({"height": "48"}, "has size 64x48; give whole numbers"),
        ({"height": 0}, "has size 64x0"),
        ({"near": "0.1"}, "near plane at 0.1, it must be finite"),
        ({"near": math.nan}, "near plane at nan"),
        ({"viewmat": changed(VIEWMAT, 0, 3, math.nan)}, "a value that is not finite"),
        ({"K": changed(K, 0, 2, math.inf)}, "a value that is not finite"),
        ({"viewmat": torch.zeros(4, 4)}, "no rotation and translation"),
        ({"viewmat": changed(VIEWMAT, 0, 0, 0.0)}, "no rotation and translation"),
        # transposed, as Inria stores it
        ({"viewmat": changed(VIEWMAT, 3, 2, 4.0)}, "no rotation and translation"),
        ({"K": changed(K, 0, 0, 0.0)}, "a focal length that is not positive"),
        ({"K": changed(K, 0, 1, 3.0)}, "a K with skew"),
        ({"K": changed(K, 2, 2, 2.0)}, "a K with skew, or whose last row is not 0, 0, 1"),
        ({"width": 0, "name": "x.png"}, r"camera 'x\.png' has size 0x48"),
    ],
)
def test_what_is_no_pinhole_is_refused(given, message):
    with refused(message):
        Camera(**{"viewmat": VIEWMAT, "K": K, "width": 64, "height": 48} | given)
