"""The dial in other people's renderers: gsplat, Inria's rasterizer and its forks, shaders."""
