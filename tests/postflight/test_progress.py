"""Progress where standard error is no terminal: plain lines, now and then; findings, a few of each kind."""

import time

from rich.console import Console

from flightmodel.checks import Issue
from postflight.terminal import MOST_ALIKE, few_of_each, plain_lines, progress_bar
from tests.refusing import numbers_in


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


def test_of_many_findings_alike_the_first_are_printed_and_counted():
    gaps = [Issue("no samples", "gap-bridged", "rates", float(k), k + 0.5) for k in range(30)]
    other = Issue("frozen", "data-frozen", "rates")
    printed = few_of_each([*gaps[:20], other, *gaps[20:]])
    assert [code for _, code in printed].count("data-frozen") == 1
    of_gaps = [words for words, code in printed if code == "gap-bridged"]
    assert of_gaps[:-1] == [gap.line for gap in gaps[: len(of_gaps) - 1]]
    assert numbers_in(of_gaps[-1]) == [30 - (len(of_gaps) - 1), 29.5]
    assert [words for words, _ in few_of_each(gaps[:MOST_ALIKE])] == [gap.line for gap in gaps[:MOST_ALIKE]]
