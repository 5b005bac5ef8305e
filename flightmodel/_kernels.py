"""Compiled primitives of the Earth and of attitudes, shared by the simulator's and the filter's kernels.

Readable twins: `flightmodel.earth`, `flightmodel.rotations`. Importing this module also points numba's cache at a
folder whose name carries a hash of the processor and of every module that imports this one: numba does not notice a
change in a callee of another file, so a stale cache must not be reachable. Where the user's cache cannot be written,
as in a container with a read-only file system, the folder is a temporary one of this process: that costs time, never
the command.
"""

from __future__ import annotations

import atexit
import contextlib
import fcntl
import hashlib
import importlib.util
import math
import os
import re
import tempfile
from dataclasses import dataclass
from pathlib import Path

import llvmlite.binding
import numba
import platformdirs
from numba import _dynfunc
from numba.core.caching import FunctionCache
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.compiler_machinery import AnalysisPass, register_pass
from numba.core.registry import CPUDispatcher
from numba.core.typed_passes import NativeLowering

# Contraction and reordering are allowed; assuming away NaN is not: telemetry marks gaps with it.
FASTMATH = {"contract", "reassoc", "arcp", "nsz", "afn"}
# a module that may hold kernels: it imports this one
HOLDS_KERNELS = re.compile(rb"\nfrom flightmodel(\._kernels import| import ([^\n]*|\([^)]*)\b_kernels\b)")
REMEDY = "set XDG_CACHE_HOME or NUMBA_CACHE_DIR to a folder that may be written"


@dataclass(frozen=True)
class CacheFolder:
    """Folder of compiled kernels: None where there is none at all; ``remark`` says why it is not the usual one."""

    path: Path | None
    remark: str = ""


def _cache_folder(name: str) -> CacheFolder:
    """Make the folder ``name`` in the user's cache, or else in a temporary one that is removed with this process.

    Child processes find the temporary one by NUMBA_CACHE_DIR. Where the home cannot be written, matplotlib keeps its
    files here too, or it would make a folder of its own and two lines of warning.
    """
    base = Path(os.environ.get("NUMBA_CACHE_DIR") or platformdirs.user_cache_dir("postflight"))
    try:
        made = CacheFolder(_writable(base / name))
    except OSError as fault:
        made = _temporary_folder(name, f"{base}: {fault.strerror}")
    if made.path is not None and not os.access(os.path.expanduser("~"), os.W_OK):
        os.environ.setdefault("MPLCONFIGDIR", str(made.path.parent / "matplotlib"))
    return made


def _temporary_folder(name: str, why: str) -> CacheFolder:
    words = f"the user's cache cannot be written ({why})"
    for place in (None, "/dev/shm"):  # a read-only container has no /tmp, but shared memory
        with contextlib.suppress(OSError):
            folder = tempfile.TemporaryDirectory(prefix="postflight-", dir=place, ignore_cleanup_errors=True)
            break
    else:
        return CacheFolder(None, f"{words}, nor temporary files: kernels are compiled in every process anew; {REMEDY}")
    atexit.register(folder.cleanup)
    os.environ["NUMBA_CACHE_DIR"] = folder.name
    return CacheFolder(
        _writable(Path(folder.name) / name), f"{words}: compiled kernels go when the command ends; {REMEDY}"
    )


def _writable(folder: Path) -> Path:
    """Make a folder and test that a file can be written in it; OSError if not (an existing folder may be read-only)."""
    if folder.parts[0] == "~":
        raise FileNotFoundError(None, "this user has no home")
    folder.mkdir(parents=True, exist_ok=True)
    tempfile.TemporaryFile(dir=folder).close()
    return folder


def _point_cache_at_these_sources() -> CacheFolder:
    digest = hashlib.sha256(f"{numba.__version__} {llvmlite.binding.get_host_cpu_name()}".encode())
    for package in ("flightmodel", "recon", "estimators", "synthetic_flight", "postflight"):
        spec = importlib.util.find_spec(package)
        for folder in (spec.submodule_search_locations or ()) if spec else ():
            for source in sorted(Path(folder).rglob("*.py")):
                text = source.read_bytes()
                if source.name == "_kernels.py" or HOLDS_KERNELS.search(text):
                    digest.update(str(source.relative_to(folder)).encode() + text)
    cache = _cache_folder(f"kernels-{digest.hexdigest()[:16]}")
    numba.config.CACHE_DIR = str(cache.path or "")
    return cache


CACHE = _point_cache_at_these_sources()
KEPT = CACHE.path is not None  # without a folder numba must not be asked for a cache: it would refuse to import


class _LockedCache(FunctionCache):
    """numba's cache of a kernel, to which one process at a time saves.

    Of two that save at once numba may give one file to two signatures: a later process would run what was compiled for
    the other.
    """

    def save_overload(self, signature, compiled):
        """Save under a lock; without one where the file system has none."""
        with (CACHE.path / "saving").open("w") as lock:
            with contextlib.suppress(OSError):
                fcntl.flock(lock, fcntl.LOCK_EX)
            super().save_overload(signature, compiled)


def _kept(function, **options):
    """Compile for calls from Python, and keep what was compiled."""
    dispatcher = numba.njit(cache=KEPT, nogil=True, error_model="numpy", **options)(function)
    if KEPT and isinstance(dispatcher, CPUDispatcher):  # else numba is switched off
        dispatcher._cache = _LockedCache(dispatcher.py_func)
    return dispatcher


def kernel(function):
    """Compile a function that is called from Python only, with the project's settings."""
    return _kept(function, fastmath=FASTMATH)


class _PartLibrary(JITCodeLibrary):
    """Unoptimised code of a part; it is copied into its callers, and optimised and compiled to machine code there."""

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
        made = state.cr.fndesc
        entry = _dynfunc.make_function(made.lookup_module(), made.qualname, "", 0, state.cr.env, (state.library,))
        state.targetctx.insert_user_function(entry, made, [state.library])
        state.cr = state.cr._replace(cfunc=entry)
        return True


class _PartCompiler(Compiler):
    """Numba's compiler reduced to the steps that a part's callers need: saves a third of all compile time."""

    def __init__(self, typing, target, _library, args, result, flags, local):
        flags.no_compile = True
        super().__init__(typing, target, _PartLibrary(target.codegen(), "part"), args, result, flags, local)

    def define_pipelines(self):
        pipelines = super().define_pipelines()
        for pipeline in pipelines:
            pipeline.add_pass_after(_Offering, NativeLowering)
            pipeline.finalize()
        return pipelines


class Part(CPUDispatcher):
    """A function that is compiled into the kernels that call it.

    numba would compile it once more for every constant that it is called with, and an entry from Python each time: a
    quarter of the time that all kernels take. Called from Python, as tests do, it becomes a kernel.
    """

    def __call__(self, *arguments):
        if not hasattr(self, "alone"):
            fastmath = self.targetoptions.get("fastmath", False)
            self.alone = _kept(self.py_func, fastmath=fastmath)
        return self.alone(*arguments)

    def get_call_template(self, args, kws):
        """Compile for the type of a number, not for its value."""
        return super().get_call_template([numba.types.unliteral(kind) for kind in args], kws)


def _part(function, **options):
    options |= {"no_cpython_wrapper": True, "no_cfunc_wrapper": True, "forceinline": True}
    part = numba.njit(nogil=True, error_model="numpy", pipeline_class=_PartCompiler, **options)(function)
    if isinstance(part, CPUDispatcher):  # else numba is switched off
        part.__class__ = Part
    return part


def inlined(function):
    """Compile as `kernel` does, and as a part of every kernel that calls it.

    A callee that stays a function of its own exists once in its own library and once in every caller's, differently
    optimised; which one runs would depend on what was compiled in the process and what came from the cache.
    """
    return _part(function, fastmath=FASTMATH)


GM, RATE = 0, 4  # their places in a `flightmodel.earth.Planet`


@inlined
def gravitation(x, y, z, planet):
    """J2 gravitation at a point with components along axes whose z is the Earth's, m/s^2."""
    r2 = x * x + y * y + z * z
    per_r2 = 1.0 / r2
    g = -planet[0] * math.sqrt(r2) * per_r2 * per_r2
    k = 1.5 * planet[1] * planet[2] * planet[2] * per_r2
    s = 5.0 * z * z * per_r2
    lateral = g * (1.0 + k * (1.0 - s))
    return lateral * x, lateral * y, g * (1.0 + k * (3.0 - s)) * z


@inlined
def geodetic(x, y, z, planet):
    """Sine and cosine of geodetic latitude, height above the ellipsoid, and 1 / distance from the axis.

    ``tan(lat) = z / (p (1 - e^2 N/(N + h)))`` with ``N/(N + h)`` to second order in the flattening: latitude to 1e-7
    rad. Height is stationary in latitude, so it is right to a micrometre from -10 to 1000 km. Square roots near one
    are series, for a flattening up to the Earth's.
    """
    a, flat = planet[2], planet[3]
    e2 = flat * (2.0 - flat)
    p2 = x * x + y * y
    per_r = 1.0 / math.sqrt(p2 + z * z)
    per_p = 1.0 / math.sqrt(p2 + 1e-300)
    ratio, s = a * per_r, z * per_r
    shrink = e2 * ratio * (1.0 + flat * s * s * (1.0 - 2.0 * ratio))
    # 1 / sqrt(1 - d)
    d = p2 * per_r * per_r * shrink * (2.0 - shrink)
    grow = 1.0 + d * (0.5 + d * (0.375 + d * (0.3125 + d * (0.2734375 + d * (0.24609375 + d * 0.2255859375)))))
    sin_lat, p_per_cos = s * grow, p2 * per_r * grow * (1.0 - shrink)
    u = e2 * sin_lat * sin_lat
    root = 1.0 - u * (0.5 + u * (0.125 + u * (0.0625 + u * (0.0390625 + u * 0.02734375))))
    return sin_lat, p_per_cos * per_p, p_per_cos + z * sin_lat - a * root, per_p


@inlined
def atan2(y, x):
    """Angle of (x, y), rad, to 3e-16: the library's cannot run in vector registers.

    Rational approximation of S. L. Moshier, Cephes (``atan.c``), arguments reduced to |t| <= 0.66.
    """
    ax, ay = abs(x), abs(y)
    low, high = min(ax, ay), max(ax, ay) + 1e-300
    far = low > 0.66 * high
    t = ((low - high) if far else low) / ((low + high) if far else high)
    z = t * t
    p = (((-8.750608600031904122785e-1 * z - 1.615753718733365076637e1) * z - 7.500855792314704667340e1) * z
         - 1.228866684490136173410e2) * z - 6.485021904942025371773e1  # fmt: skip
    q = ((((z + 2.485846490142306297962e1) * z + 1.650270098316988542046e2) * z + 4.328810604912902668951e2) * z
         + 4.853903996359136964868e2) * z + 1.945506571482613964425e2  # fmt: skip
    angle = t + t * z * p / q + (0.25 * math.pi if far else 0.0)
    angle = 0.5 * math.pi - angle if ay > ax else angle
    angle = math.pi - angle if x < 0.0 else angle
    return math.copysign(angle, y)


@inlined
def rotation(q0, q1, q2, q3):
    """Direction cosine matrix of a unit quaternion, nine numbers by rows."""
    return (
        1.0 - 2.0 * (q2 * q2 + q3 * q3), 2.0 * (q1 * q2 - q0 * q3), 2.0 * (q1 * q3 + q0 * q2),
        2.0 * (q1 * q2 + q0 * q3), 1.0 - 2.0 * (q1 * q1 + q3 * q3), 2.0 * (q2 * q3 - q0 * q1),
        2.0 * (q1 * q3 - q0 * q2), 2.0 * (q2 * q3 + q0 * q1), 1.0 - 2.0 * (q1 * q1 + q2 * q2),
    )  # fmt: skip


@inlined
def times(m, x, y, z):
    return m[0] * x + m[1] * y + m[2] * z, m[3] * x + m[4] * y + m[5] * z, m[6] * x + m[7] * y + m[8] * z


@inlined
def back(m, x, y, z):
    return m[0] * x + m[3] * y + m[6] * z, m[1] * x + m[4] * y + m[7] * z, m[2] * x + m[5] * y + m[8] * z


@inlined
def symmetric(m, x, y, z):
    return m[0] * x + m[1] * y + m[2] * z, m[1] * x + m[3] * y + m[4] * z, m[2] * x + m[4] * y + m[5] * z


@inlined
def cross(a0, a1, a2, b0, b1, b2):
    return a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0


@inlined
def turned(c, m):
    """C M C^T of a symmetric matrix, as six numbers."""
    a0, a1, a2 = symmetric(m, c[0], c[1], c[2])
    b0, b1, b2 = symmetric(m, c[3], c[4], c[5])
    d0, d1, d2 = symmetric(m, c[6], c[7], c[8])
    return (
        c[0] * a0 + c[1] * a1 + c[2] * a2, c[3] * a0 + c[4] * a1 + c[5] * a2, c[6] * a0 + c[7] * a1 + c[8] * a2,
        c[3] * b0 + c[4] * b1 + c[5] * b2, c[6] * b0 + c[7] * b1 + c[8] * b2, c[6] * d0 + c[7] * d1 + c[8] * d2,
    )  # fmt: skip


@inlined
def solved(m, x, y, z):
    """Solution of a symmetric 3x3 system by cofactors."""
    c0, c1, c2 = m[3] * m[5] - m[4] * m[4], m[2] * m[4] - m[1] * m[5], m[1] * m[4] - m[2] * m[3]
    c3, c4, c5 = m[0] * m[5] - m[2] * m[2], m[1] * m[2] - m[0] * m[4], m[0] * m[3] - m[1] * m[1]
    d = 1.0 / (m[0] * c0 + m[1] * c1 + m[2] * c2)
    return (c0 * x + c1 * y + c2 * z) * d, (c1 * x + c3 * y + c4 * z) * d, (c2 * x + c4 * y + c5 * z) * d


@inlined
def centripetal(w0, w1, w2, x, y, z):
    """w x (w x r)."""
    along, square = w0 * x + w1 * y + w2 * z, w0 * w0 + w1 * w1 + w2 * w2
    return w0 * along - x * square, w1 * along - y * square, w2 * along - z * square


@inlined
def gyroscopic(inertia, w0, w1, w2):
    """w x I w."""
    h0, h1, h2 = symmetric(inertia, w0, w1, w2)
    return cross(w0, w1, w2, h0, h1, h2)


@inlined
def dcm_from_quaternion(w, x, y, z, out):
    """Direction cosine matrix of a unit quaternion, into ``out`` (3, 3)."""
    m = rotation(w, x, y, z)
    out[0, 0], out[0, 1], out[0, 2] = m[0], m[1], m[2]
    out[1, 0], out[1, 1], out[1, 2] = m[3], m[4], m[5]
    out[2, 0], out[2, 1], out[2, 2] = m[6], m[7], m[8]


@inlined
def boxplus(q, d0, d1, d2):
    """Turn the quaternion ``q`` (4,) in place by the rotation vector (d0, d1, d2), rad, and renormalise it."""
    half2 = 0.25 * (d0 * d0 + d1 * d1 + d2 * d2)
    half = math.sqrt(half2)
    c = math.cos(half)
    s = 0.5 * (math.sin(half) / half if half > 1e-8 else 1.0 - half2 / 6.0)
    w, x, y, z = q[0], q[1], q[2], q[3]
    ex, ey, ez = s * d0, s * d1, s * d2
    q0 = w * c - x * ex - y * ey - z * ez
    q1 = w * ex + x * c + y * ez - z * ey
    q2 = w * ey - x * ez + y * c + z * ex
    q3 = w * ez + x * ey - y * ex + z * c
    n = 1.0 / math.sqrt(q0 * q0 + q1 * q1 + q2 * q2 + q3 * q3)
    q[0], q[1], q[2], q[3] = q0 * n, q1 * n, q2 * n, q3 * n


@inlined
def multiply(a, b, rows, between, columns, out):
    """``out = a b`` of leading rows and columns; neither shares memory with ``out``."""
    for i in range(rows):
        for j in range(columns):
            out[i, j] = 0.0
        for k in range(between):
            f = a[i, k]
            for j in range(columns):
                out[i, j] += f * b[k, j]


@inlined
def small_cholesky(s, count, factor):
    """Lower factor of the leading ``count`` rows of ``s``, of a few unknowns; it may take the place of ``s``.

    Written out: of LAPACK's call the compiler makes more than of this, and so few unknowns wait longer for it.
    """
    for i in range(count):
        for j in range(i + 1):
            value = s[i, j]
            for col in range(j):
                value -= factor[i, col] * factor[j, col]
            factor[i, j] = math.sqrt(value) if i == j else value / factor[j, j]


@inlined
def small_solve(factor, count, y):
    """Solve ``L L^T out = y`` in place of the leading ``count`` of ``y``."""
    for i in range(count):
        for col in range(i):
            y[i] -= factor[i, col] * y[col]
        y[i] /= factor[i, i]
    for r in range(count):
        i = count - 1 - r
        for col in range(i + 1, count):
            y[i] -= factor[col, i] * y[col]
        y[i] /= factor[i, i]
