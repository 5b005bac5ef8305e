"""Progress where standard error is no terminal: plain lines, now and then, and none of what is quickly done."""

import time

from rich.console import Console

from postflight.progress import plain_lines, progress_bar


def test_lines_tell_the_step_again_and_again(capsys):
    with plain_lines(Console(stderr=True, soft_wrap=True), 0.05) as tell:
        tell(0.25, "filter [pass 1]")
        time.sleep(0.4)
        tell(2.0, "done")
        time.sleep(0.1)
    lines = capsys.readouterr().err.splitlines()
    assert 3 <= len(lines) <= 10
    assert lines[0] == "0 s: 25 %, filter [pass 1]"
    assert lines[-1].endswith("s: 100 %, done")


def test_what_is_quickly_done_says_nothing(capsys):
    with progress_bar() as tell:
        tell(0.5, "half")
    seen = capsys.readouterr()
    assert seen.err == ""
    assert seen.out == ""
