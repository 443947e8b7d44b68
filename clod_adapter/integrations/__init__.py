"""The dial in other renderers: gsplat, Inria's rasterizer and its forks, shaders."""
