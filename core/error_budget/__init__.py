"""The error budget: bounds, what a set of instances is worth to each tile, the search for sets that keep to it,
estimates with confidence.

No rays are traced here: callers bring logs. What is not known is charged, never taken for zero.
"""
