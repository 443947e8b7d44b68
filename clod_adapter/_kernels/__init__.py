"""Compiled CPU kernels, imported on first use, not by ``import clod_adapter``."""
