"""Compiled CPU kernels. Everything in here is imported on first use, never by ``import clod_adapter``."""
