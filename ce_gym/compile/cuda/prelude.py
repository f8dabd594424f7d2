"""Beginning of every emitted source: C text of types, copies of the values of a robot, random numbers and look-ups.

Random numbers and look-ups are also implemented for the CPU, in `random` and `lookup`. Tests hold both equal.
"""

from ce_gym.compile.lowering.random import FIRST_FACTOR, GOLDEN, RANDOM_BITS, SECOND_FACTOR

TYPES = {
    "float64": """typedef EACH(double) real;
typedef EACH(unsigned long long) bits;
typedef EACH(long long) signed_bits;
#define INFINITE __longlong_as_double(0x7ff0000000000000ll)
#define NOT_A_NUMBER __longlong_as_double(0x7ff8000000000000ll)
""",
    "float32": """typedef EACH(float) real;
typedef EACH(unsigned int) bits;
typedef EACH(int) signed_bits;
#define INFINITE __int_as_float(0x7f800000)
#define NOT_A_NUMBER __int_as_float(0x7fc00000)
""",
}

THREAD = """// `host` defines these for the CPU, where a value may stand for several threads.
#ifdef __CUDACC__
#define EACH(T) T

template <class T> __device__ __forceinline__ T choose(bool yes, T a, T b) { return yes ? a : b; }
#endif

typedef EACH(bool) mask;
typedef EACH(unsigned long long) word;
"""

LIMBS = """
#ifdef __CUDACC__
template <class T> __device__ __forceinline__ T fetch(const T* from, word i) { return from[i]; }

template <class T, class U> __device__ __forceinline__ void put(bool yes, T* to, word i, U x)
{
    if (yes) to[i] = T(x);
}

// Whether a flag is set for some robot of the warp.
__device__ __forceinline__ bool any(bool flag) { return __any_sync(0xffffffffu, flag); }

// The value of the thread of another limb of the same robot.
template <int COUNT> __device__ __forceinline__ real from_limb(real x, int limb)
{
    return __shfl_sync(0xffffffffu, x, limb, COUNT);
}
#endif
"""

COPIES = """
// Arrays that stay on the GPU are (size, robots), so that neighbouring threads read neighbouring numbers.
template <int SIZE> __device__ __forceinline__ void read_lane(real* to, const real* from, word lane, word robots)
{
#pragma unroll
    for (int i = 0; i < SIZE; ++i) to[i] = from[i * robots + lane];
}

template <int SIZE> __device__ __forceinline__ void write_lane(real* to, const real* from, word lane, word robots)
{
#pragma unroll
    for (int i = 0; i < SIZE; ++i) to[i * robots + lane] = from[i];
}

// Arrays that come and go are (robots, size), as everywhere else.
template <int SIZE, class T> __device__ __forceinline__ void read_row(real* to, const T* from, word lane)
{
#pragma unroll
    for (int i = 0; i < SIZE; ++i) to[i] = real(from[lane * SIZE + i]);
}

template <int SIZE, class T> __device__ __forceinline__ void write_row(T* to, const real* from, word lane)
{
#pragma unroll
    for (int i = 0; i < SIZE; ++i) to[lane * SIZE + i] = T(from[i]);
}
"""

RANDOM = """
// splitmix64, see ce_gym/compile/lowering/random.py.
__device__ __forceinline__ word mix(word x)
{{
    x = (x ^ (x >> 30)) * {first:#x}ull;
    x = (x ^ (x >> 27)) * {second:#x}ull;
    return x ^ (x >> 31);
}}

__device__ __forceinline__ word start_of(word key, word counter)
{{
    return mix(mix(key + {golden:#x}ull) ^ (counter * {golden:#x}ull));
}}

template <int SIZE> __device__ __forceinline__ word draw(real* to, word state)
{{
    for (int i = 0; i < SIZE; ++i) {{
        state = state + {golden:#x}ull;
        to[i] = real((EACH(long long))(mix(state) >> {shift})) * real({scale});
    }}
    return state;
}}
"""

LOOKUP = """
// One axis of the surface of ce_gym/compile/lowering/lookup.py: the first of three entries, their weights and slopes.
struct Along {
    int first;
    real weight[3], slope[3];
};

__device__ __forceinline__ Along along(real u, int count, real& t, real& beyond)
{
    const real number = real(count), half = real(0.5);
    // Both comparisons are false for a NaN, which so becomes a number before it becomes an index.
    real inside = u > half ? u : half;
    const real upper = number - real(1.5), last = number - real(2.0);
    inside = inside < upper ? inside : upper;
    real nearest = floor(inside + half);
    nearest = nearest < last ? nearest : last;
    t = inside - nearest;
    beyond = u - inside;
    Along a;
    a.first = int(nearest) - 1;
    return a;
}

__device__ __forceinline__ Along with_slopes(real u, int count)
{
    const real half = real(0.5);
    real t, beyond;
    Along a = along(u, count, t, beyond);
    a.slope[0] = t - half;
    a.slope[1] = real(-2.0) * t;
    a.slope[2] = t + half;
    a.weight[0] = half * (a.slope[0] * a.slope[0]) + a.slope[0] * beyond;
    a.weight[1] = real(0.75) - t * t + a.slope[1] * beyond;
    a.weight[2] = half * (a.slope[2] * a.slope[2]) + a.slope[2] * beyond;
    return a;
}

// The same of ce_gym/compile/lowering/lookup_values.py: the nearest entry, weights of its two neighbours.
struct Near {
    int entry;
    real before, after;
};

__device__ __forceinline__ Near near(real u, int count)
{
    const real number = real(count), half = real(0.5), one = real(1.0);
    real inside = u > half ? u : half;
    const real upper = number - real(1.5), last = number - real(2.0);
    inside = inside < upper ? inside : upper;
    real nearest = rint(inside);
    nearest = nearest < last ? nearest : last;
    nearest = nearest > one ? nearest : one;
    const real t = inside - nearest, beyond = u - inside, low = t - half, high = t + half;
    return {int(nearest), low * fma(half, low, beyond), high * fma(half, high, beyond)};
}

__device__ __forceinline__ real mean(Near n, real before, real middle, real after)
{
    return fma(n.after, after - middle, fma(n.before, before - middle, middle));
}

__device__ __forceinline__ real weighed(const real* w, const real* x)
{
    return w[0] * x[0] + w[1] * x[1] + w[2] * x[2];
}

template <int POINTS> __device__ void look_up(
    const real* table, int rows, int columns, const real* frame, const real* points, real* found)
{
    const real per_cell = real(1.0) / frame[2];
#pragma unroll 1
    for (int p = 0; p < POINTS; ++p) {
        const Along r = with_slopes((points[2 * p] - frame[0]) * per_cell, rows);
        const Along c = with_slopes((points[2 * p + 1] - frame[1]) * per_cell, columns);
        real value[3], slope[3];
        for (int i = 0; i < 3; ++i) {
            const real* line = table + (long long)(r.first + i) * columns + c.first;
            const real entries[3] = {line[0], line[1], line[2]};
            value[i] = weighed(c.weight, entries);
            slope[i] = weighed(c.slope, entries);
        }
        found[3 * p] = weighed(r.weight, value);
        found[3 * p + 1] = weighed(r.slope, value) * per_cell;
        found[3 * p + 2] = weighed(r.weight, slope) * per_cell;
    }
}

__device__ __forceinline__ real value_at(const real* table, int rows, int columns, real u, real w)
{
    const Near r = near(u, rows), c = near(w, columns);
    const real* at = table + (long long)r.entry * columns + c.entry;
    real found[3];
    for (int j = 0; j < 3; ++j) found[j] = mean(r, at[j - 1 - columns], at[j - 1], at[j - 1 + columns]);
    return mean(c, found[0], found[1], found[2]);
}

template <int POINTS> __device__ void look_up_values(
    const real* table, int rows, int columns, const real* frame, const real* points, real* found)
{
    const real per_cell = real(1.0) / frame[2];
#pragma unroll 1
    for (int p = 0; p < POINTS; ++p) {
        const real u = (points[2 * p] - frame[0]) * per_cell, w = (points[2 * p + 1] - frame[1]) * per_cell;
        found[p] = value_at(table, rows, columns, u, w);
    }
}

// ce_gym/compile/lowering/lookup_grid.py; `pose` has the cosine and sine of the grid's angle, then where it is put.
template <int PLACES, int POINTS> __device__ void look_up_grid(
    const real* table, int rows, int columns, const real* grid, const real* frame, const real* pose, real* found)
{
    const real per_cell = real(1.0) / frame[2], c = pose[0] * per_cell, s = pose[1] * per_cell;
    for (int i = 0; i < PLACES; ++i) {
        const real* at = pose + 2 + 2 * i;
        const real u = (at[0] - frame[0]) * per_cell, w = (at[1] - frame[1]) * per_cell;
#pragma unroll 1
        for (int p = 0; p < POINTS; ++p) {
            const real x = grid[2 * p], y = grid[2 * p + 1];
            found[POINTS * i + p] = value_at(table, rows, columns, fma(x, c, fma(y, -s, u)), fma(x, s, fma(y, c, w)));
        }
    }
}
"""


def prelude(dtype: str, *, limbs: bool, random: bool, lookup: bool) -> str:
    """Return the beginning of a source.

    Args:
        dtype: `float64` or `float32`.
        limbs: whether a thread computes a limb, and not a robot.
        random: whether random numbers are drawn.
        lookup: whether tables are looked up.
    """
    shift = 64 - RANDOM_BITS[dtype]
    scale = (2.0 ** -RANDOM_BITS[dtype]).hex()
    figures = {"first": FIRST_FACTOR, "second": SECOND_FACTOR, "golden": GOLDEN, "shift": shift, "scale": scale}
    parts = (LIMBS if limbs else COPIES, RANDOM.format(**figures) if random else "", LOOKUP if lookup else "")
    return THREAD + TYPES[dtype] + "".join(parts)
