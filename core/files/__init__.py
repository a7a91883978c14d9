"""Files that are whole or not there, the report and the states of a run, and what a process has used.

Formats are read by others: keys may be added, not renamed.
"""
