"""The demo: a small ray-traced gallery as ground truth, independent of splatting, and figures of the results."""
