"""A container: no HOME, a user without a name, a read-only file system. It costs time, never the command."""

import os
import shutil
import subprocess
import sys

import pytest

from tests.refusing import printed_codes

CACHES = ("HOME", "XDG_CACHE_HOME", "NUMBA_CACHE_DIR", "MPLCONFIGDIR", "POSTFLIGHT_CACHE")
# `kernel` compiles; `style` imports what draws
USE = """
from flightmodel import _kernels
import postflight.plots.deflection, postflight.commands as commands
commands.compile_kernels()
commands.compile_kernels()
import flightmodel.earth
print(_kernels.CACHE.path or "none")
"""
# everything but the folders named behind is read-only, as `docker run --read-only --user 12345 --volume FOLDER` has it
READ_ONLY = "--user --map-user=12345 --map-group=12345 --keep-caps --mount"
MOUNTS = """
set -e
mount --make-rprivate /
mount --bind "$0" "$0"
mount -o remount,bind,ro /
! touch / 2>/dev/null
exec "$@"
"""


def bare(**more):
    return {k: v for k, v in os.environ.items() if k not in CACHES} | {"COLUMNS": "500", **more}


def read_only(writable):
    """Command before a command that runs it as user 12345 where ``writable`` alone can be written."""
    before = ["unshare", *READ_ONLY.split(), "sh", "-c", MOUNTS, str(writable)]
    if shutil.which("unshare") is None or subprocess.run([*before, "true"], capture_output=True).returncode:
        pytest.skip("namespaces are not permitted here")
    return before


def run(before, code, **more):
    return subprocess.run([*before, sys.executable, "-c", code], env=bare(**more), capture_output=True, text=True)


def test_read_only_machine_and_unknown_user(tmp_path):
    done = run(read_only(tmp_path), f"import os; assert os.getuid() == 12345; {USE}")
    assert done.returncode == 0, done.stderr
    folder = done.stdout.strip()
    assert "postflight-" in folder, "a private folder of the process"
    assert not os.path.exists(folder), "it goes with its process"
    assert printed_codes(done.stderr) == ["no-cache"], "one line, and once"
    assert len(done.stderr.splitlines()) == 1, done.stderr


def test_nowhere_to_write_at_all(tmp_path):
    """Without any temporary folder kernels are compiled in the process; numba does not refuse to import them.

    Only drawing then fails: matplotlib insists on a folder.
    """
    refused = "import tempfile\ndef no(*_, **__): raise OSError(30, 'read-only')\ntempfile.mkdtemp = no\n"
    (tmp_path / "file").touch()
    code = refused + USE.replace("postflight.plots.deflection, postflight.commands as", "postflight.warmup as")
    code = code.replace("commands.compile_kernels()\n", "commands.prepare((), print)\n")
    done = run([], code, HOME=str(tmp_path), XDG_CACHE_HOME=str(tmp_path / "file"))
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "none"


def test_a_cache_that_exists_but_cannot_be_written(tmp_path):
    """The kernels' own folder is there, of another user's making."""
    cache = tmp_path / "cache"
    assert run([], USE, HOME=str(tmp_path), XDG_CACHE_HOME=str(cache)).returncode == 0
    writable = tmp_path / "other"
    writable.mkdir()
    done = run(read_only(writable), USE, HOME=str(tmp_path), XDG_CACHE_HOME=str(cache))
    assert done.returncode == 0, done.stderr
    assert "postflight-" in done.stdout
    assert printed_codes(done.stderr) == ["no-cache"]
    assert str(cache) in done.stderr


def test_no_home_and_a_cache_that_is_named(tmp_path):
    """As the line advises: then nothing is said, by matplotlib neither."""
    done = run(read_only(tmp_path), USE, XDG_CACHE_HOME=str(tmp_path / "cache"))
    assert (done.returncode, done.stderr) == (0, ""), done.stderr
    assert done.stdout.startswith(str(tmp_path / "cache"))


@pytest.mark.parametrize("command", [["check"], ["export", "--to", "csv"], ["score"]])
def test_commands_on_a_read_only_machine(tmp_path, flight, command):
    """What writes nothing, or has nothing to write, answers as everywhere."""
    done = subprocess.run(
        [*read_only(tmp_path), sys.executable, "-m", "postflight.cli", command[0], str(flight.root), *command[1:]],
        env=bare(), capture_output=True, text=True,
    )  # fmt: skip
    assert "Traceback" not in done.stderr
    assert done.returncode == (0 if command == ["check"] else 3), done.stderr


def test_without_the_bench_s_library_every_other_command_is_there(tmp_path):
    """Werkzeug serves the film's page alone; without it the command says how to install it."""
    absent = "import sys; sys.modules['werkzeug'] = None; from postflight.cli import main; "
    done = run([], f"{absent}sys.argv[1:] = ['camera', {str(tmp_path)!r}]; main()")
    assert (done.returncode, printed_codes(done.stderr)) == (2, ["package-missing"])
    assert "postflight[bench]" in done.stderr
    done = run([], f"{absent}import postflight.commands, postflight.report.write; sys.argv[1:] = ['--help']; main()")
    assert done.returncode == 0, done.stderr
