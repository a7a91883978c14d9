"""Measurements that make the tables and plots of docs/: benchmarks, evaluation reports, hybrid and animation studies.

A study states machine and command at the head of its page; numbers come from its run alone.
"""
