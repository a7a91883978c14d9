"""Tools for developers from a checkout: the lock, the extension's zips, fuzzing, accuracy, the demo's and the guide's
pictures.

Not needed at run time; `make` calls most of them.
"""
