"""memory.csv: what is written is read again, one row for each thing."""

import dataclasses
import os
import subprocess
import sys

import pytest

from lipac.core.files.memory_table import COLUMNS, MemoryRow, merged, read_rows, write_rows
from lipac.core.files.report import Report

ROW = MemoryRow("object", "lamp", 30, 30, 10, 20, 0, 2, 1, 0.25, 1, 2, 3, 4, 5, 1, 'met, "often"\nand seen')


def other(**changes):
    return dataclasses.replace(ROW, **changes)


def test_columns(tmp_path):
    write_rows(tmp_path, [ROW])
    first, *_ = (tmp_path / "memory.csv").read_text().splitlines()
    expected = "kind,name,bytes,full_bytes,geometry_bytes,bvh_bytes,image_bytes,instances,kept,worth,"
    assert first == expected + "camera,diffuse,glossy,transmission,shadow,frame,why"
    assert first.split(",") == list(COLUMNS)


def test_what_is_written_is_read_again(tmp_path):
    rows = [
        ROW,
        other(
            kind="image",
            name="a, b",
            worth=None,
            camera=None,
            diffuse=None,
            glossy=None,
            transmission=None,
            shadow=None,
        ),
    ]
    write_rows(tmp_path, rows)
    assert read_rows(tmp_path) == rows


def test_a_file_of_something_else_is_nothing(tmp_path):
    assert read_rows(tmp_path) == []
    for text in ("", "kind,name\nobject,x\n", ",".join(COLUMNS) + "\nobject,x,many\n", "\0"):
        (tmp_path / "memory.csv").write_text(text)
        assert read_rows(tmp_path) == []


def test_each_thing_once_where_it_takes_most_and_the_largest_first():
    small, large = other(bytes=10, frame=1), other(bytes=50, frame=2)
    mesh = other(kind="mesh", bytes=40)
    assert merged([small, mesh, large]) == merged([large, small, mesh]) == [large, mesh]


def report(seed=0):
    return Report("s", "", "", "light-paths", "cycles", seed, 1)


def test_beside_the_report_of_all_commands_that_fill_a_folder(tmp_path):
    first = report()
    first.add_frame({"frame": 1}, memory=[ROW])
    first.write(tmp_path)
    second = report()
    second.add_frame({"frame": 2}, memory=[other(bytes=99, frame=2), other(name="chair", bytes=1, frame=2)])
    second.write(tmp_path)
    assert [(row.name, row.bytes, row.frame) for row in read_rows(tmp_path)] == [("lamp", 99, 2), ("chair", 1, 2)]
    anew = report(seed=1)
    anew.add_frame({"frame": 1}, memory=[other(name="new")])
    anew.write(tmp_path)
    assert [row.name for row in read_rows(tmp_path)] == ["new"]


@pytest.mark.skipif(os.name == "nt", reason="the locale is asked for by variables")
def test_any_name_is_written_whatever_the_locale(tmp_path):
    """Where text is ASCII unless it is said: kernels' sources are read, rows written and read."""
    code = (
        "import sys, pathlib, locale; assert locale.getencoding() != 'utf-8'; "
        "from lipac.tests.core.files.test_memory_table import other, read_rows, write_rows; "
        "folder, row = pathlib.Path(sys.argv[1]), other(name='W\\xfcrfel \\u2603'); "
        "write_rows(folder, [row]); sys.exit(read_rows(folder) != [row])"
    )
    plain = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    subprocess.run([sys.executable, "-c", code, str(tmp_path)], env=os.environ | plain, check=True)
