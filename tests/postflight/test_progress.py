"""Progress where standard error is no terminal: plain lines, now and then, and none of a short command."""

import time

from rich.console import Console

from postflight.terminal import plain_lines, progress_bar


def test_lines_repeat_a_long_step(capsys):
    with plain_lines(Console(stderr=True, soft_wrap=True), 0.05) as report:
        report(0.25, "filter [pass 1]")
        time.sleep(0.4)
        report(2.0, "done")
        time.sleep(0.1)
    lines = capsys.readouterr().err.splitlines()
    assert 3 <= len(lines) <= 10
    assert lines[0] == "0 s: 25 %, filter [pass 1]"
    assert lines[-1].endswith("s: 100 %, done")


def test_a_short_command_prints_nothing(capsys):
    with progress_bar() as report:
        report(0.5, "half")
    seen = capsys.readouterr()
    assert seen.err == ""
    assert seen.out == ""
