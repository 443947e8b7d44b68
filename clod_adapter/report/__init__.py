"""Presentation of results: figures in one style, and the self-contained HTML report.

Takes plain rows, from any source.
"""
