"""Commands' work on frames of the open file: pipeline, engines, hybrid frame, verification, one set for a shot, a baked copy.

No operator and no panel imports from here but `shot_set`; what is written goes through `core.files`.
"""
