"""The equation for renderers in other languages: ``attenuation.glsl``, ``.hlsl`` and ``.wgsl``,
``golden.json``.

``golden.json`` has test cases for such functions, with the names of its columns. A float32 result
passes if it differs from the last column by at most ``tolerance`` times the opacity in ``rows``,
and times itself in ``scale_rows``; where ``drawn`` is 0 it must be 0.
"""
