"""The nerfstudio method ``clod-splatfacto``; ``method`` is imported by nerfstudio alone."""
