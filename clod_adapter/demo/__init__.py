"""The demo: a small ray-traced gallery, whose ground truth owes nothing to splatting, and pictures of the results."""
