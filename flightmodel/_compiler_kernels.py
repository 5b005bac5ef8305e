"""How are kernels' parts compiled, and how in half the time? What numba's compiler does otherwise for this project.

A part is code for its callers alone. numba would optimise each by itself, turn it into machine code that nobody runs,
and optimise it again in every caller.

Where may compiled kernels be kept? In the user's cache; where that cannot be written, in a folder of this process.

A container has often neither a home nor a user's name, and a file system that may only be read. Whatever is missing
there costs time, never the command.
"""

from __future__ import annotations

import atexit
import contextlib
import operator
import os
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path

from numba import _dynfunc, types
from numba.core import ir
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.compiler_machinery import AnalysisPass, register_pass
from numba.core.typed_passes import NativeLowering
from numba.core.types.functions import BaseFunction

REMEDY = "set XDG_CACHE_HOME or NUMBA_CACHE_DIR to a folder that may be written"
OPERATORS = {value for name, value in vars(operator).items() if name[0] != "_" and callable(value)}
PLACES = (operator.getitem, operator.setitem)


@dataclass(frozen=True)
class CacheFolder:
    """A folder for what is compiled: None where there is none at all; ``remark`` says why it is not the usual one."""

    path: Path | None
    remark: str = ""


def cache_folder(name: str) -> CacheFolder:
    """Make the folder ``name`` in the user's cache, or else in a private temporary one that goes with this process.

    Child processes find the temporary one by NUMBA_CACHE_DIR. Where the home cannot be written, matplotlib keeps its
    files here too, or it would make a folder of its own and two lines of warning.
    """
    stated, xdg = os.environ.get("NUMBA_CACHE_DIR"), os.environ.get("XDG_CACHE_HOME")
    base = Path(stated or (Path(xdg) if xdg else Path.home() / ".cache") / "postflight")
    try:
        made = CacheFolder(_writable(base / name))
    except OSError as fault:
        made = _private_folder(name, f"{base}: {fault.strerror}")
    if made.path is not None and not os.access(Path.home(), os.W_OK):
        os.environ.setdefault("MPLCONFIGDIR", str(made.path.parent / "matplotlib"))
    return made


def _private_folder(name: str, why: str) -> CacheFolder:
    words = f"the user's cache cannot be written ({why})"
    for place in (None, "/dev/shm"):  # a read-only container has no /tmp, but shared memory
        with contextlib.suppress(OSError):
            private = Path(tempfile.mkdtemp(prefix="postflight-", dir=place))
            break
    else:
        return CacheFolder(None, f"{words}, nor temporary files: kernels are compiled in every process anew; {REMEDY}")
    atexit.register(_remove, private, os.getpid())
    os.environ["NUMBA_CACHE_DIR"] = str(private)
    return CacheFolder(_writable(private / name), f"{words}: compiled kernels go when the command ends; {REMEDY}")


def _writable(folder: Path) -> Path:
    """Make a folder and put a file into it, or raise OSError: what exists may still be read-only."""
    folder.mkdir(parents=True, exist_ok=True)
    tempfile.TemporaryFile(dir=folder).close()
    return folder


def _remove(folder: Path, owner: int) -> None:
    if os.getpid() == owner:  # a fork leaves by the same door
        shutil.rmtree(folder, ignore_errors=True)


class _PartLibrary(JITCodeLibrary):
    """A part's code as it was written, to be copied into its callers."""

    def _optimize_final_module(self):
        pass

    def _finalize_final_module(self):
        self._finalized = True


@register_pass(mutates_CFG=False, analysis_only=True)
class _Offering(AnalysisPass):
    """Last pass over a part: its callers find the code under an entry without an address."""

    _name = "part_offering"

    def __init__(self):
        super().__init__()

    def run_pass(self, state):
        """Name the code to the callers."""
        made = state.cr.fndesc
        entry = _dynfunc.make_function(made.lookup_module(), made.qualname, "", 0, state.cr.env, (state.library,))
        state.targetctx.insert_user_function(entry, made, [state.library])
        state.cr = state.cr._replace(cfunc=entry)
        return True


class PartCompiler(Compiler):
    """Compile a part as far as its callers need it."""

    def __init__(self, typing, target, _library, args, result, flags, local):
        flags.no_compile = True
        super().__init__(typing, target, _PartLibrary(target.codegen(), "part"), args, result, flags, local)

    def define_pipelines(self):
        """Add the offering to numba's own passes."""
        pipelines = super().define_pipelines()
        for pipeline in pipelines:
            pipeline.add_pass_after(_Offering, NativeLowering)
            pipeline.finalize()
        return pipelines


def remember_operators():
    """Let this process look up only once what an operator makes of the same numbers, or of the same array and place.

    numba tries every meaning of an operator at every use, text and sets too: a fifth of the time that compiling takes.
    """
    look_up = BaseFunction.get_call_type

    def get_call_type(self, context, args, kws):
        if kws or self.typing_key not in OPERATORS or not _plain(self.typing_key, args):
            return look_up(self, context, args, kws)
        known = self.__dict__.setdefault("_known", {})
        if args not in known:
            known[args] = look_up(self, context, args, kws)
        return known[args]

    BaseFunction.get_call_type = get_call_type


def _plain(key, args):
    if key in PLACES:
        return isinstance(args[0], types.Array)
    return all(isinstance(a, types.Number | types.Boolean) for a in args)


# what numba asks, in this order, of everything that an instruction holds
KINDS = (ir.Var, ir.Inst, (list, tuple), dict)


def list_variables_by_type():
    """Let this process ask once of a type, and not of each of a million objects, whether it holds variables.

    numba lists an instruction's variables after every change of a function: an eighth of the time that compiling takes.
    """
    known = {}

    def add(value, found):
        kind = known.get(type(value), -1)
        if kind == -1:
            kind = next((k for k, one in enumerate(KINDS) if isinstance(value, one)), None)
            known[type(value)] = kind
        if kind == 0:
            found.append(value)
        elif kind == 1:
            found += value.list_vars()
        elif kind is not None:
            for each in value.values() if kind == 3 else value:
                add(each, found)

    def _rec_list_vars(_self, value):
        found = []
        add(value, found)
        return found

    ir.Inst._rec_list_vars = _rec_list_vars
