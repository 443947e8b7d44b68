"""The equation for renderers in other languages: ``attenuation.glsl``, ``attenuation.wgsl``, ``golden.json``.

``golden.json`` has test cases for such functions, with the names of its columns. A float32 result passes if it differs
from the last column by at most ``tolerance`` times it, in ``rows`` times ``faded``, and is 0 where ``drawn`` is 0.
"""
