"""Judging from outside: pictures with and without, error metrics, the oracle, policies side by side, a view of the
TLAS.

The judge uses no number that the analysis used: keep it so.
"""
