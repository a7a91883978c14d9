"""Surface models: lobes, their layers by Cycles' rules, and tables of GGX albedo.

A lobe is added in `lobes`, `setup`, `evaluate` and `sample`; it must pass the chi-square and reciprocity tests, and the
comparison with Cycles.
"""
