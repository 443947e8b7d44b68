"""The equation for renderers in other languages: ``attenuation.glsl``, ``attenuation.wgsl``, ``golden.json``.

``golden.json`` holds cases that any such function is to be tested with, made by ``golden.py`` from ``attenuation.py``.
"""
