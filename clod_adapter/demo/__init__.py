"""The demo: the photographs of a ray-traced gallery, a checkpoint trained on them, and figures of the results."""
