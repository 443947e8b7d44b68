"""The equation for renderers in other languages: ``attenuation.glsl``, ``attenuation.wgsl``, ``golden.json``.

``golden.json`` has test cases for such functions, made by ``golden.py`` from ``attenuation.py``.
"""
