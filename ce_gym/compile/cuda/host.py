"""Emitted CUDA C on the CPU: a C++ compiler compiles the same text with a few definitions in place of CUDA.

This is for tests and comparisons without a GPU. It checks arithmetic, copies and the order of stages. It does not check
that a GPU rounds according to IEEE 754, and says little about speed.
"""

from __future__ import annotations

import ctypes
import hashlib
import importlib.util
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from ce_gym.compile.cache import cache_folder, read_or_make
from ce_gym.compile.cuda.source import ENTRY, Source

SHIM = """#include <cmath>
#include <cstring>
using namespace std;
#define __device__
#define __constant__ static
#define __global__
#define __forceinline__ inline
#define __noinline__
#define __launch_bounds__(...)
static double __longlong_as_double(long long a) { double b; memcpy(&b, &a, 8); return b; }
static long long __double_as_longlong(double a) { long long b; memcpy(&b, &a, 8); return b; }
static float __int_as_float(int a) { float b; memcpy(&b, &a, 4); return b; }
static int __float_as_int(float a) { int b; memcpy(&b, &a, 4); return b; }
"""

ALONE = """
#define EACH(T) T
#define WARP 1
template <class T> T choose(bool yes, T a, T b) { return yes ? a : b; }
struct Place { unsigned x; };
static thread_local Place blockIdx, threadIdx;
static void set_thread(unsigned first) { threadIdx.x = first; }
"""
"""Threads run one after the other."""

TOGETHER = r"""
#define EACH(T) Lanes<T>
#define WARP 16
#define EVERY(i) for (int i = 0; i < WARP; ++i)
#define BINARY(R, SIGN) \
    friend Lanes<R> operator SIGN(Lanes a, Lanes b) \
    { \
        Lanes<R> c; \
        EVERY(i) c.lane[i] = a.lane[i] SIGN b.lane[i]; \
        return c; \
    }
#define SHIFT(SIGN) \
    template <class U> friend Lanes operator SIGN(Lanes a, Lanes<U> b) \
    { \
        EVERY(i) a.lane[i] = a.lane[i] SIGN b.lane[i]; \
        return a; \
    } \
    friend Lanes operator SIGN(Lanes a, int b) { return a SIGN Lanes<int>(b); }

template <class T> struct Lanes {
    T lane[WARP];
    Lanes() {}
    Lanes(T x) { EVERY(i) lane[i] = x; }
    template <class U> explicit Lanes(const Lanes<U>& x) { EVERY(i) lane[i] = T(x.lane[i]); }
    Lanes operator-() const { Lanes c; EVERY(i) c.lane[i] = -lane[i]; return c; }
    Lanes<bool> operator!() const { Lanes<bool> c; EVERY(i) c.lane[i] = !lane[i]; return c; }
    BINARY(T, +) BINARY(T, -) BINARY(T, *) BINARY(T, /) BINARY(T, %) BINARY(T, &) BINARY(T, |) BINARY(T, ^)
    BINARY(bool, <) BINARY(bool, >) BINARY(bool, <=) BINARY(bool, >=) BINARY(bool, ==) BINARY(bool, !=)
    SHIFT(<<) SHIFT(>>)
};

#define UNARY(R, T, NAME) static R NAME(T a) { R c; EVERY(i) c.lane[i] = NAME(a.lane[i]); return c; }
#define OF_TWO(T, NAME) static T NAME(T a, T b) { EVERY(i) a.lane[i] = NAME(a.lane[i], b.lane[i]); return a; }
#define FUNCTIONS(T, f) \
    UNARY(T, T, sqrt##f) UNARY(T, T, fabs##f) UNARY(T, T, floor##f) UNARY(T, T, ceil##f) \
    UNARY(T, T, rint##f) UNARY(T, T, trunc##f) OF_TWO(T, fmin##f) OF_TWO(T, fmax##f) OF_TWO(T, copysign##f) \
    static T fma##f(T a, T b, T c) { EVERY(i) c.lane[i] = fma##f(a.lane[i], b.lane[i], c.lane[i]); return c; }
FUNCTIONS(Lanes<float>, f)
FUNCTIONS(Lanes<double>, )
UNARY(Lanes<double>, Lanes<long long>, __longlong_as_double)
UNARY(Lanes<long long>, Lanes<double>, __double_as_longlong)
UNARY(Lanes<float>, Lanes<int>, __int_as_float)
UNARY(Lanes<int>, Lanes<float>, __float_as_int)

typedef Lanes<unsigned long long> Words;
struct Place { Words x; };
static thread_local Place blockIdx, threadIdx;
static void set_thread(unsigned first) { EVERY(i) threadIdx.x.lane[i] = first + i; }

template <class T> T choose(Lanes<bool> yes, T a, T b)
{
    EVERY(i) if (yes.lane[i]) b.lane[i] = a.lane[i];
    return b;
}

template <class T> Lanes<T> fetch(const T* from, Words at)
{
    Lanes<T> c;
    EVERY(i) c.lane[i] = from[at.lane[i]];
    return c;
}

template <class T, class U> void put(Lanes<bool> yes, T* to, Words at, Lanes<U> x)
{
    EVERY(i) if (yes.lane[i]) to[at.lane[i]] = T(x.lane[i]);
}

static bool any(Lanes<bool> flag)
{
    EVERY(i) if (flag.lane[i]) return true;
    return false;
}

template <int COUNT, class T> Lanes<T> from_limb(Lanes<T> x, int limb)
{
    Lanes<T> c;
    EVERY(i) c.lane[i] = x.lane[i - i % COUNT + limb];
    return c;
}
"""
"""A value stands for all threads of a warp, which so can exchange values. A warp has 16 threads here."""

OPTIONS = ("-std=c++17", "-O0", "-w", "-ffp-contract=off", "-shared", "-fPIC")
"""Without optimisation, which takes minutes; nothing is fused or reordered."""


def host_compiler() -> list[str] | None:
    """Return the command of a C++ compiler, the one of the package `ziglang` if the machine has none, or None."""
    for name in ("c++", "g++", "clang++"):
        if found := shutil.which(name):
            return [found]
    if importlib.util.find_spec("ziglang"):
        return [sys.executable, "-m", "ziglang", "c++"]
    return None


class HostLauncher:
    """Runs an emitted kernel robot by robot on arrays in the CPU's memory.

    Args:
        source: The kernel; compiled only if its library is not in the cache.

    Raises:
        RuntimeError: One line, if there is no C++ compiler or it refuses the source.
    """

    def __init__(self, source: Source) -> None:
        compiler = host_compiler()
        if compiler is None:
            raise RuntimeError("no C++ compiler (c++, g++, clang++ or the package ziglang) to run CUDA C on the host")
        threads = ALONE if source.threads == 1 else TOGETHER
        text = SHIM + threads + source.text + _loop(source.text, source.threads)
        name = "host_" + hashlib.sha256(" ".join((*compiler, *OPTIONS, text)).encode()).hexdigest()[:24]
        _, code = read_or_make(cache_folder(), name, lambda: ({}, _compile(compiler, text, source.layout.name)))
        self._run = _load(code).run_all

    def __call__(self, addresses: Sequence[int], numbers: Sequence[int], count: int) -> None:
        """Run the kernel on all robots.

        Args:
            addresses: Of the arrays, in the order of the layout.
            numbers: Rows and columns of tables, repeat counts.
            count: Number of robots.
        """
        self._run(*map(ctypes.c_void_p, addresses), *map(ctypes.c_int, numbers), ctypes.c_int(count))


def _compile(compiler: list[str], text: str, name: str) -> bytes:
    """Return a shared library."""
    with tempfile.TemporaryDirectory(prefix="ce_gym-") as folder:
        file, library = Path(folder) / "kernel.cpp", Path(folder) / "kernel.so"
        file.write_text(text, encoding="utf-8")
        result = subprocess.run([*compiler, *OPTIONS, str(file), "-o", str(library)], capture_output=True, text=True)
        if result.returncode:
            errors = [line for line in result.stderr.splitlines() if "error" in line]
            raise RuntimeError(f"{name}: {(errors or [result.stderr])[0]}")
        return library.read_bytes()


def _load(code: bytes) -> ctypes.CDLL:
    """Load a shared library from a temporary file."""
    with tempfile.TemporaryDirectory(prefix="ce_gym-", ignore_cleanup_errors=True) as folder:
        file = Path(folder) / "kernel.so"
        file.write_bytes(code)
        return ctypes.CDLL(str(file))


def _loop(text: str, threads: int) -> str:
    """Return a C function with the arguments of the kernel that runs the threads of all robots."""
    found = re.search(rf'extern "C" __global__ void [^;{{]*? {ENTRY}\((?P<arguments>[^)]*)\)', text)
    assert found, "no kernel in the source"
    arguments = " ".join(found["arguments"].split())
    names = ", ".join(part.split()[-1] for part in arguments.split(","))
    return f"""
extern "C" void run_all({arguments})
{{
    blockIdx.x = 0;
    for (unsigned first = 0; first < {threads} * unsigned(count); first += WARP) {{
        set_thread(first);
        {ENTRY}({names});
    }}
}}
"""
