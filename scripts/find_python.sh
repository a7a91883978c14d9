#!/bin/sh
# Prints the path of a Python that really runs and can make a venv: the first found of the versions given, e.g. `find_python.sh 3.13 3.11`.
# A pyenv shim may exist and still refuse to run, so every candidate is started; pyenv's own folders are looked into as well.
for version in "$@"; do
    for candidate in "python$version" "${PYENV_ROOT:-$HOME/.pyenv}/versions/$version"*/bin/python python3 python; do
        found=$("$candidate" -c "import ensurepip, sys, venv; print(sys.executable if '%d.%d' % sys.version_info[:2] == '$version' else '')" 2>/dev/null)
        if [ -n "$found" ]; then
            echo "$found"
            exit 0
        fi
    done
done
echo "no Python $* found: install one, or name one with PYTHON=/path/to/python" >&2
exit 1
