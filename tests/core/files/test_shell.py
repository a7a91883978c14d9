"""Paths in command lines."""

import os
import subprocess
import sys

import pytest

from lipac.core.files.shell import quoted


def test_plain_paths_are_as_they_are():
    assert quoted("/shots/sh010/out.json") == "/shots/sh010/out.json"


@pytest.mark.skipif(os.name == "nt", reason="quotes and the like are no names on Windows")
@pytest.mark.parametrize("name", ["my shot", "it's", "a;b", "$HOME", 'a"b', "é ü"])
def test_a_shell_reads_one_word(name):
    code = f"{quoted(sys.executable)} -c 'import sys; print(sys.argv[1:])' {quoted(name)}"
    done = subprocess.run(code, shell=True, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == str([name])
