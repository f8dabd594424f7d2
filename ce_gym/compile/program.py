"""Programs of kernels as data: buffers, and steps that read and write them, which are calls and table look-ups."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal, TypeAlias, get_args

if TYPE_CHECKING:
    import casadi

Grid: TypeAlias = tuple[tuple[float, float], ...]
"""x and y of points relative to a place that is known only at run time."""
BufferKind = Literal["tiles", "rows_in", "rows_out", "scratch", "random", "table"]


@dataclass(frozen=True)
class Buffer:
    """Memory for a vector of values in every lane; one lane is one environment.

    Attributes:
        name: in calls, and for callers of the kernel.
        size: values per lane; 0 for a table.
        kind: owner and layout:

            * `tiles`: array (n_tiles, size, lanes) of the kernel's dtype, owned by the caller, changed in place.
            * `rows_in`: array (num_envs, size), converted to lanes before the first call of a tile. Padding lanes of
              the last tile repeat its last row.
            * `rows_out`: array (num_envs, size), written from lanes after the last call of a tile.
            * `scratch`: passes values from one call to the next within a tile; the kernel owns it.
            * `random`: uniform numbers in [0, 1), new in every tile. Draw i of a lane is a function of the lane's key,
              its counter and i only.
            * `table`: array (rows, columns) of the kernel's dtype, at least 3 by 3, shared by all lanes and read by
              `Lookup` only. Its shape is known when the kernel is called.
        dtype: of a `rows_*` array, `float32` or `float64`; empty means the dtype of the kernel.
        within: name of the buffer that contains this one; empty for a buffer of its own. `tiles` contain no others.
        start: first value of this buffer within that one.
    """

    name: str
    size: int
    kind: BufferKind
    dtype: str = ""
    within: str = ""
    start: int = 0


@dataclass(frozen=True)
class Call:
    """One SX function applied to the lanes of a tile.

    Attributes:
        function: the SX function. Each input and output fills one whole buffer, column by column.
        inputs: buffer of each function input.
        outputs: buffer of each function output; may be the buffer of an input, since all loads precede all stores.
        only_if: a buffer of size 1. Tiles skip the call where the buffer is zero in all lanes. To keep lanes
            independent of their neighbours, the call must change nothing in a lane where the buffer is zero.
        times: number of applications of the function. A buffer that is `times` as large as its argument is traversed
            argument by argument; all others are the same in every application.
        short_if_zero: outputs of size 1 that the function itself chooses by. Tiles where such an output is zero in all
            lanes skip the operations that matter elsewhere only, with the same bits.
        again: the only inputs that have changed since the previous call, which is of the same function. Operations that
            depend on no other changes are not repeated.
    """

    function: casadi.Function
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    only_if: str = ""
    times: int = 1
    short_if_zero: tuple[str, ...] = ()
    again: tuple[str, ...] = ()


@dataclass(frozen=True)
class Lookup:
    """Interpolation of a table by a smooth surface at points of every lane; see `compile/lowering/lookup.py`.

    Attributes:
        table: a `table` buffer. Entry (i, j) is the value at `x = x0 + i cell`, `y = y0 + j cell`.
        frame: buffer of size 3 with `x0`, `y0` and `cell` of each lane.
        points: buffer of size 2 n with x and y of each point. With a grid of m points, buffer of size 2 + 2 n / m with
            cosine and sine of the angle of the grid, then x and y of each of its places.
        output: buffer of size 3 n, none of the above, with the value and its slopes along x and y for each point;
            without slopes of size n.
        slopes: whether slopes are computed; values alone take half the time.
        grid: points relative to each place, values only. A grid takes less time than as many points.
    """

    table: str
    frame: str
    points: str
    output: str
    slopes: bool = True
    grid: Grid = ()

    def size_of_output(self, size_of_points: int) -> int:
        """Return the size of the output, given the size of the buffer of points."""
        n = size_of_points // 2
        return len(self.grid) * (n - 1) if self.grid else (3 if self.slopes else 1) * n

    @property
    def inputs(self) -> tuple[str, ...]:
        """Buffers with values per lane that the look-up reads."""
        return (self.frame, self.points)

    @property
    def outputs(self) -> tuple[str, ...]:
        """Buffers that the look-up writes."""
        return (self.output,)


@dataclass(frozen=True)
class While:
    """Steps repeated in order while a buffer is nonzero in some lane of a tile.

    To keep lanes independent of their neighbours, values that the steps write in a lane where the buffer is zero must
    not be read later.

    Attributes:
        flag: the buffer, of size 1, which the steps write.
        calls: the repeated steps.
    """

    flag: str
    calls: tuple[Call | Lookup, ...]


@dataclass(frozen=True)
class Foreign:
    """A C function of the caller, called once for each tile.

    Its arguments are the number of the first environment of the tile and the number of environments, then for each
    buffer a pointer to its lanes, shape (size, lanes), and its size. All integers have 64 bits.

    Attributes:
        function: name of a run-time integer, the address of the function.
        buffers: buffers that the function reads and may change.
    """

    function: str
    buffers: tuple[str, ...]


Step: TypeAlias = Call | Lookup | While | Foreign


@dataclass(frozen=True)
class Repeat:
    """Steps repeated in order a number of times.

    Attributes:
        times: name of a run-time integer.
        calls: the repeated steps.
    """

    times: str
    calls: tuple[Step, ...]


def calls_of(steps: Sequence[Step | Repeat]) -> Iterator[Call | Lookup]:
    """Yield all calls and look-ups of steps, repeated ones once."""
    for step in steps:
        if isinstance(step, Repeat | While):
            yield from calls_of(step.calls)
        elif not isinstance(step, Foreign):
            yield step


def run_time_integers(steps: Sequence[Step | Repeat]) -> Iterator[str]:
    """Yield the names of the integers that the caller passes: numbers of repetitions, and addresses of functions."""
    yield from (step.times for step in steps if isinstance(step, Repeat))
    yield from (step.function for step in _foreign_steps(steps))


def scratch_buffers(steps: Sequence[Step | Repeat], known: Collection[str]) -> list[Buffer]:
    """Return scratch buffers for all values that steps write, except `known` buffers; the first write sets the size."""
    sizes: dict[str, int] = {}
    for call in calls_of(steps):
        if isinstance(call, Lookup):
            sizes.setdefault(call.output, call.size_of_output(sizes[call.points]))
        else:
            for i, name in enumerate(call.outputs):
                sizes.setdefault(name, call.times * call.function.numel_out(i))
    return [Buffer(name, size, "scratch") for name, size in sizes.items() if name not in known]


@dataclass(frozen=True)
class Program:
    """Steps run in order on every tile.

    Attributes:
        name: for people, `mini_cheetah exact environment`.
        buffers: all buffers of the steps.
        steps: in the order of execution.
        skip_unless: a `tiles` buffer of size 1; tiles skip the program where the buffer is zero in all lanes.
        compact: whether to emit small code: a call processes the lanes of a tile register by register, stores results
            early, and is compiled with fewer passes. For functions that do not fit into a level-2 cache.
    """

    name: str
    buffers: tuple[Buffer, ...]
    steps: tuple[Step | Repeat, ...]
    skip_unless: str = ""
    compact: bool = False

    @property
    def calls(self) -> tuple[Call | Lookup, ...]:
        """All calls and look-ups, repeated ones once."""
        return tuple(calls_of(self.steps))

    @property
    def flags(self) -> set[str]:
        """Flags of all `While` loops."""
        inner = [step for outer in self.steps for step in (outer.calls if isinstance(outer, Repeat) else (outer,))]
        return {step.flag for step in inner if isinstance(step, While)}


def check_program(program: Program) -> None:
    """Check that a program can be compiled and that its result does not depend on earlier runs.

    Raises:
        ValueError: one line with the program, the buffer or call, and the expected value.
    """
    buffers = {buffer.name: buffer for buffer in program.buffers}
    if len(buffers) != len(program.buffers):
        raise ValueError(f"program {program.name!r}: buffer names must differ from each other")
    for buffer in program.buffers:
        _check_buffer(program.name, buffer)
        if buffer.within:
            _check_part(program.name, buffer, buffers)
    written = {b.name for b in program.buffers if b.kind in ("tiles", "rows_in", "random")}
    before: Call | Lookup | None = None
    for number, call in enumerate(program.calls):
        read = call.inputs
        if isinstance(call, Lookup):
            place = f"program {program.name!r}: call {number} (look-up in {call.table!r})"
            _check_lookup(place, call, buffers)
        else:
            place = f"program {program.name!r}: call {number} ({call.function.name()})"
            _check_call(place, call, buffers)
            _check_again(place, call, before)
            if call.only_if:
                _check_flag(f"{place}: only_if", buffers.get(call.only_if))
                read = (*read, call.only_if)
            for name in call.short_if_zero:
                _check_flag(f"{place}: short_if_zero", buffers.get(name))
                if name not in call.outputs:
                    raise ValueError(f"{place}: short_if_zero {name!r}, expected one of its outputs")
        if unset := [name for name in read if name not in written]:
            raise ValueError(f"{place}: reads {unset[0]!r}, expected an earlier call to write it first")
        written.update(call.outputs)
        written.update(buffers[name].within for name in call.outputs)
        before = call
    for step in _foreign_steps(program.steps):
        for name in step.buffers:
            _check_lanes(f"program {program.name!r}: function {step.function!r}", name, buffers)
    if unset := [b.name for b in program.buffers if b.name not in written and b.kind == "rows_out"]:
        raise ValueError(f"program {program.name!r}: no call writes the rows_out buffer {unset[0]!r}")
    for flag in program.flags:
        _check_flag(f"program {program.name!r}: flag {flag!r} of a loop", buffers.get(flag))
        if flag not in written:
            raise ValueError(f"program {program.name!r}: reads {flag!r}, expected a call to write it")
    if program.skip_unless:
        _check_flag(f"program {program.name!r}: skip_unless", buffers.get(program.skip_unless), ("tiles",))


def _foreign_steps(steps: Sequence[Step | Repeat]) -> Iterator[Foreign]:
    for step in steps:
        if isinstance(step, Foreign):
            yield step
        elif isinstance(step, Repeat | While):
            yield from _foreign_steps(step.calls)


def _check_flag(place: str, flag: Buffer | None, kinds: tuple[str, ...] = ("tiles", "scratch")) -> None:
    if flag is None or flag.kind not in kinds or flag.size != 1:
        raise ValueError(f"{place} must name a {' or '.join(kinds)} buffer of size 1")


def _check_buffer(program: str, buffer: Buffer) -> None:
    place = f"program {program!r}: buffer {buffer.name!r}"
    if buffer.kind not in get_args(BufferKind):
        raise ValueError(f"{place}: kind {buffer.kind!r}, expected one of {', '.join(get_args(BufferKind))}")
    if buffer.kind == "table" and buffer.size != 0:
        raise ValueError(f"{place}: size {buffer.size}, expected 0 for a table")
    if buffer.kind != "table" and buffer.size < 1:
        raise ValueError(f"{place}: size {buffer.size}, expected at least 1")
    allowed = ("", "float32", "float64") if buffer.kind.startswith("rows") else ("",)
    if buffer.dtype not in allowed:
        raise ValueError(f"{place}: dtype {buffer.dtype!r}, expected one of {allowed} for {buffer.kind}")
    if buffer.within and buffer.kind != "scratch":
        raise ValueError(f"{place}: kind {buffer.kind!r}, expected 'scratch' for a part of {buffer.within!r}")


def _check_part(program: str, part: Buffer, buffers: dict[str, Buffer]) -> None:
    whole = buffers.get(part.within)
    if whole is None or whole.kind == "tiles" or whole.within or not 0 <= part.start <= whole.size - part.size:
        place = f"program {program!r}: buffer {part.name!r}"
        raise ValueError(f"{place}: part of {part.within!r} from {part.start}, expected to lie within a buffer")


def _check_call(place: str, call: Call, buffers: dict[str, Buffer]) -> None:
    function = call.function
    if not function.is_a("SXFunction"):
        raise ValueError(f"{place}: {function.class_name()}, expected an SX function (expand it first)")
    if len(set(call.outputs)) != len(call.outputs):
        raise ValueError(f"{place}: outputs {call.outputs}, expected different buffers")
    sides = (
        ("input", call.inputs, function.n_in(), function.numel_in),
        ("output", call.outputs, function.n_out(), function.numel_out),
    )
    for side, names, count, numel in sides:
        if len(names) != count:
            raise ValueError(f"{place}: {len(names)} {side} buffers, expected {count}")
        for position, name in enumerate(names):
            _check_lanes(f"{place}: {side}", name, buffers)
            if buffers[name].size not in (numel(position), call.times * numel(position)):
                expected = f"{numel(position)} as {side} {position} of the function"
                raise ValueError(f"{place}: buffer {name!r} has size {buffers[name].size}, expected {expected}")


def _check_again(place: str, call: Call, before: Call | Lookup | None) -> None:
    if not call.again:
        return
    if not set(call.again) <= set(call.inputs):
        raise ValueError(f"{place}: again {call.again}, expected some of its inputs")
    if not isinstance(before, Call) or replace(before, only_if="", again=()) != replace(call, only_if="", again=()):
        raise ValueError(f"{place}: again, expected it right after a call of the same function with the same buffers")
    if not (before.again or not before.only_if) or call.times > 1:
        raise ValueError(f"{place}: again, expected the first such call without only_if, and none with times")
    if changed := set(call.outputs) & set(call.inputs) - set(call.again):
        raise ValueError(f"{place}: again {call.again}, but it changes {min(changed)!r}, too")


def _check_lookup(place: str, lookup: Lookup, buffers: dict[str, Buffer]) -> None:
    table = buffers.get(lookup.table)
    if table is None or table.kind != "table":
        raise ValueError(f"{place}: expected the name of a table buffer")
    for side, name in (("frame", lookup.frame), ("points", lookup.points), ("output", lookup.output)):
        _check_lanes(f"{place}: {side}", name, buffers)
    if lookup.output in lookup.inputs:
        raise ValueError(f"{place}: output {lookup.output!r} is an input too, expected another buffer")
    if lookup.grid and lookup.slopes:
        raise ValueError(f"{place}: slopes of a grid, expected values alone")
    points = buffers[lookup.points].size
    sizes = (
        ("frame", lookup.frame, 3),
        ("points", lookup.points, points // 2 * 2),
        ("output", lookup.output, lookup.size_of_output(points)),
    )
    for side, name, size in sizes:
        if buffers[name].size != size:
            raise ValueError(f"{place}: {side} buffer {name!r} has size {buffers[name].size}, expected {size}")


def _check_lanes(place: str, name: str, buffers: dict[str, Buffer]) -> None:
    if name not in buffers:
        raise ValueError(f"{place} buffer {name!r} is not among the program's buffers")
    if buffers[name].kind == "table":
        raise ValueError(f"{place} buffer {name!r} is a table, expected one with values per lane")
