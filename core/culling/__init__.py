"""The method: rounds of request and build, measurement, search, certificate; one frame (`analysis`) and a shot
(`shot`).

A policy decides by `options`; states must be the same for a seed at any number of threads.
"""
