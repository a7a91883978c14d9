"""Commands' work on frames of the open file: the decision, one frame, one set for a shot, verification, a baked copy.

No operator and no panel imports from here but `shots.shot_set`; what is written goes through `core.files`.
"""
