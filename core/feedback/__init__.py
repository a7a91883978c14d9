"""What paths report: hits per instance, light per instance and coarse tile, and logs of what each path met.

Plain counters and records that kernels fill; sums are of integers, so they do not depend on the order of threads.
"""
