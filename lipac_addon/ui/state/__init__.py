"""What the user has set and what analyses have found: properties, preferences, results, and whether renders are culled
by them.

No drawing and no jobs here. Properties are saved in files: names stay.
"""
