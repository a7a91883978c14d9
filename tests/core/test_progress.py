"""Progress and its time left."""

import io
import math

from lipac.core.progress import Pace, Terminal, clock, part


class Console(io.StringIO):
    def isatty(self):
        return True


def test_time_left_is_extrapolated():
    now = [0.0]
    stream = Console()
    with Terminal(stream, lambda: now[0]) as progress:
        for fraction in (0.0, 0.25):
            progress(fraction, "tracing")
            now[0] += 10.0
        progress(0.5, "tracing")
    shown = stream.getvalue().split("\r")
    assert shown[-3].strip() == "50 % tracing (20 s, 20 s left)"
    assert shown[-2].strip() == ""  # cleared
    assert "\n" not in stream.getvalue()


def test_where_the_share_is_not_known_nothing_is_extrapolated():
    terminal = Terminal(io.StringIO(), lambda: 100.0)
    assert terminal.line(math.nan, "compiling", 112.0) == "      compiling (12 s)"


def test_a_file_gets_few_whole_lines():
    now = [0.0]
    stream = io.StringIO()
    progress = Terminal(stream, lambda: now[0])
    for k in range(100):
        progress(k / 100, "x")
        now[0] += 0.2
    lines = stream.getvalue().splitlines()
    assert 2 <= len(lines) <= 5
    assert "left" in lines[-1]


def test_parts_nest():
    seen = []
    whole = part(lambda f, w: seen.append((f, w)), 0.5, 1.0, "a ")
    part(whole, 0.0, 0.5, "b ")(0.5, "c")
    assert seen == [(0.625, "a b c")]


def test_clock():
    assert [clock(s) for s in (0.04, 9.94, 59, 61, 3723)] == ["0.0 s", "9.9 s", "59 s", "1:01", "1:02:03"]


def test_the_time_left_is_counted_from_where_it_was_first_known():
    pace = Pace(100.0)
    assert pace.words(math.nan, 104.0) == "4.0 s"
    assert pace.words(0.2, 110.0) == "0.0 s"
    assert pace.words(0.6, 130.0) == "20 s, 20 s left"
