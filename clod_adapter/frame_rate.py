"""The control law that holds a frame time: from the milliseconds of the last frames to the dial
value of the next.

With (s_i, t_i) the dial value and the milliseconds of frame i, i = 1 the newest, and T the budget,
frame i predicts

    e_i = log(t_i / T) + 0.75 log(s_i / s_1)

as the excess of a frame at s_1: a frame's time is taken to fall as s^-0.75. The excess e is the
median of e_i over the newest frames whose dial value is within 15 % of s_1, at least 3 and at most
20. If the median of the newest 3 differs from it by more than 3 % and by more than 3 times the
median deviation of these frames from it, the load has changed, and the median of the 3 is e. Then

    log s = log s_1 + sign(e) min(max(|e| - 0.03, 0), log 1.1),    s clamped to [1, max_sv]

A single slow frame has no influence; a dial at rest averages 20 frames, one in motion follows the
newest 3. Where t = a + b s^-p, p from 0.2 to 1.5, and the load changes by 2, 4 or 1/3, t is within
10 % of T at most 15 frames later, or 4 frames after steps of 10 % can reach it; it ends within 3 %
of T. With a noise of 20 % per frame the dial rests in most frames and changes by 0.6 % a frame on
average. viewers/frame_rate.js has the same law.
"""

import math
from collections.abc import Sequence
from statistics import median

FRAMES = 20  # at most so many frames enter the law
NEWEST = 3  # frames: one outlier has no influence on their median
EXPONENT = 0.75  # of the prediction
SAME_DIAL = 0.15  # in log s: frames that count as frames of the present dial value
DEAD_BAND = 0.03  # in log t: smaller excesses leave the dial where it is
OUTLIER = 3.0  # median deviations of a changed load
STEP = math.log(1.1)  # largest change of log s per frame

TimedFrame = tuple[float, float]


def excess(frames: Sequence[TimedFrame], milliseconds: float) -> float:
    """e of dial values and milliseconds, oldest first, at least one; positive if frames take longer
    than allowed.
    """
    predicted = []
    for age, (dial, took) in enumerate(reversed(frames[-FRAMES:])):
        distance = math.log(dial / frames[-1][0])
        if age >= NEWEST and abs(distance) > SAME_DIAL:
            break
        predicted.append(math.log(max(took / milliseconds, 1e-3)) + EXPONENT * distance)
    present = median(predicted)
    newest = median(predicted[:NEWEST])
    noise = median(abs(prediction - present) for prediction in predicted)
    return newest if abs(newest - present) > max(DEAD_BAND, OUTLIER * noise) else present


def next_dial(frames: Sequence[TimedFrame], milliseconds: float, max_sv: float) -> float:
    """The dial value of the next frame, in [1, max_sv]; that of the newest frame until there are
    3.
    """
    dial = frames[-1][0]
    if len(frames) < NEWEST:
        return dial
    off = excess(frames, milliseconds)
    step = math.copysign(min(max(abs(off) - DEAD_BAND, 0.0), STEP), off)
    return min(max(dial * math.exp(step), 1.0), max_sv)
