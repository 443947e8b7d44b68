"""The nerfstudio method ``clod-splatfacto``; ``method`` and ``model`` are imported by nerfstudio alone."""
