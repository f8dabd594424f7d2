"""LLVM code of one tile: skip test, rows to lanes, random numbers, steps, lanes to rows."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import reduce
from itertools import groupby
from typing import TypeAlias

import casadi
from llvmlite import ir

from ce_gym.compile.arrays import ALIGNMENT
from ce_gym.compile.layout import Layout
from ce_gym.compile.lowering.function import Arguments, arguments_of, lower_function, split_function
from ce_gym.compile.lowering.lookup import Table, emit_lookup
from ce_gym.compile.lowering.lookup_grid import emit_grid_lookup
from ce_gym.compile.lowering.lookup_values import emit_value_lookup
from ce_gym.compile.lowering.partial_evaluation import Fragment, Part, Split
from ce_gym.compile.lowering.random import emit_uniform
from ce_gym.compile.lowering.vector import Builder, Value, VectorBuilder, loop
from ce_gym.compile.program import Buffer, Call, Foreign, Lookup, Program, Repeat, Step, While

INT = ir.IntType(64)
FLOATS = {"float64": ir.DoubleType(), "float32": ir.FloatType()}
Pairs: TypeAlias = frozenset[tuple[int, int]]
MANY = 64
"""Rows with at least this many values are written block by block."""


def emit_tile(builder: Builder, program: Program, layout: Layout, arguments: tuple[Value, ...], parts: int = 1) -> None:
    """Emit the work on one tile at the builder's position.

    Args:
        builder: of the function that loops over tiles.
        program: the program.
        layout: calling convention of the program.
        arguments: 64-bit integers: addresses of the address table, of the repeat counts and of the scratch memory of
            the thread; number of the tile; number of environments.
        parts: number of parts into which a call splits the lanes of a tile.
    """
    work = _TileWork(builder, program, layout, arguments, parts)
    if not program.skip_unless:
        work.emit()
        return
    with builder.if_then(work.any_lane(program.skip_unless)):
        work.emit()


class _TileWork:
    """Addresses of the buffers of one tile, and the code that uses them."""

    def __init__(
        self, builder: Builder, program: Program, layout: Layout, arguments: tuple[Value, ...], parts: int
    ) -> None:
        table, repeats, scratch, tile, num_envs = arguments
        self.builder, self.program, self.layout = builder, program, layout
        self.vectors = VectorBuilder(builder, layout.dtype)
        self.parts = parts
        self.table = builder.inttoptr(table, INT.as_pointer())
        self.repeats = builder.inttoptr(repeats, INT.as_pointer())
        self.last_env = builder.sub(num_envs, INT(1))
        self.first_env = builder.mul(tile, INT(self.vectors.lanes))
        remaining = builder.sub(num_envs, self.first_env)
        self.valid_lanes = self._smaller(remaining, INT(self.vectors.lanes))
        self.lanes = {b.name: self._lanes_of(b, scratch, tile) for b in program.buffers if b.kind != "table"}
        self.bodies: dict[tuple[casadi.Function, Pairs, Fragment | None], ir.Function] = {}
        repeated = [call for call in program.calls if isinstance(call, Call) and call.again]
        self.changing = {call.function: _changing(call) for call in repeated}
        self.splits: dict[tuple[casadi.Function, Pairs], Split] = {}
        self.kept: dict[Split, Value] = {}

    def any_lane(self, name: str) -> Value:
        """Return whether a buffer of size 1 is nonzero in some lane."""
        v, bits = self.vectors, ir.IntType(self.vectors.lanes)
        set_lanes = v.compare("!=", v.load(self.lanes[name], 0), v.const(0.0))
        return self.builder.icmp_unsigned("!=", self.builder.bitcast(set_lanes, bits), bits(0))

    def emit(self) -> None:
        """Emit all work on the tile, in order."""
        kinds = {
            kind: [b for b in self.program.buffers if b.kind == kind] for kind in ("rows_in", "random", "rows_out")
        }
        for buffer in kinds["rows_in"]:
            self._rows_to_lanes(buffer)
        if kinds["random"]:
            self._fill_random(kinds["random"])
        for step in self.program.steps:
            self._step(step)
        for buffer in kinds["rows_out"]:
            self._lanes_to_rows(buffer)

    def _address(self, position: int) -> Value:
        """Return an entry of the address table, as an integer."""
        return self.builder.load(self.builder.gep(self.table, [INT(position)]))

    def _array(self, buffer: Buffer) -> Value:
        return self._address(self.layout.arguments.index(buffer))

    def _lanes_of(self, buffer: Buffer, scratch: Value, tile: Value) -> Value:
        """Return a pointer to the first vector of a buffer in this tile."""
        if buffer.kind == "tiles":
            offset = self.builder.mul(tile, INT(ALIGNMENT * buffer.size))
            address = self.builder.add(self._array(buffer), offset)
        else:
            address = self.builder.add(scratch, INT(self.layout.scratch_offsets[buffer.name]))
        return self.builder.inttoptr(address, self.vectors.float_type.as_pointer())

    def _rows_to_lanes(self, buffer: Buffer) -> None:
        """Copy the rows of this tile to lanes; lanes past the last environment repeat its row."""
        b = self.builder
        with loop(b, INT(self.vectors.lanes), "lane") as lane:
            row = self._smaller(b.add(self.first_env, lane), self.last_env)
            with self._elements(buffer, row, lane) as (row_element, lane_element):
                b.store(_convert(b, b.load(row_element), FLOATS[self.layout.dtype]), lane_element)

    def _lanes_to_rows(self, buffer: Buffer) -> None:
        """Copy the lanes of real environments to their rows."""
        b, lanes = self.builder, INT(self.vectors.lanes)
        if buffer.size < MANY:
            self._each_lane_to_its_row(buffer)
            return
        with b.if_else(b.icmp_signed("==", self.valid_lanes, lanes)) as (whole, partial):
            with whole:
                self._blocks_to_rows(buffer)
            with partial:
                self._each_lane_to_its_row(buffer)

    def _each_lane_to_its_row(self, buffer: Buffer) -> None:
        """Copy values one by one."""
        b = self.builder
        with loop(b, self.valid_lanes, "lane") as lane:
            row = b.add(self.first_env, lane)
            with self._elements(buffer, row, lane) as (row_element, lane_element):
                b.store(_convert(b, b.load(lane_element), FLOATS[buffer.dtype or self.layout.dtype]), row_element)

    def _blocks_to_rows(self, buffer: Buffer) -> None:
        """Copy square blocks, one value per lane, transposed; the last block may overlap the one before."""
        b, v, n = self.builder, self.vectors, self.vectors.lanes
        row_type = FLOATS[buffer.dtype or self.layout.dtype]
        rows = b.inttoptr(self._array(buffer), row_type.as_pointer())
        lanes, last = self.lanes[buffer.name], INT(buffer.size - n)
        with loop(b, INT(-(-buffer.size // n)), "block") as block:
            first = self._smaller(b.mul(block, INT(n)), last)
            start = b.gep(lanes, [first])
            for lane, vector in enumerate(v.transposed([v.load(start, i) for i in range(n)])):
                row = b.add(b.mul(b.add(self.first_env, INT(lane)), INT(buffer.size)), first)
                to = ir.VectorType(row_type, n)
                place = b.bitcast(b.gep(rows, [row]), to.as_pointer())
                b.store(_convert(b, vector, to), place, align=8 if row_type == FLOATS["float64"] else 4)

    @contextmanager
    def _elements(self, buffer: Buffer, row: Value, lane: Value) -> Iterator[tuple[Value, Value]]:
        """Loop over the values of one environment and yield pointers to each value in its row and in its lane."""
        b = self.builder
        row_type = FLOATS[buffer.dtype or self.layout.dtype]
        rows = b.inttoptr(self._array(buffer), row_type.as_pointer())
        lanes = b.bitcast(self.lanes[buffer.name], FLOATS[self.layout.dtype].as_pointer())
        row_start = b.mul(row, INT(buffer.size))
        with loop(b, INT(buffer.size), "value") as value:
            in_lanes = b.add(b.mul(value, INT(self.vectors.lanes)), lane)
            yield b.gep(rows, [b.add(row_start, value)]), b.gep(lanes, [in_lanes])

    def _fill_random(self, buffers: list[Buffer]) -> None:
        """Draw the numbers of all random buffers from the key and counter of each lane."""
        keys, counters = (self._words(self._address(self.layout.keys + i)) for i in range(2))
        emit_uniform(self.vectors, keys, counters, [(self.lanes[b.name], b.size) for b in buffers])

    def _words(self, address: Value) -> Value:
        """Return one 64-bit integer per lane, from an array with one per environment."""
        b = self.builder
        words = b.inttoptr(address, INT.as_pointer())
        result: Value = ir.Constant(ir.VectorType(INT, self.vectors.lanes), ir.Undefined)
        for lane in range(self.vectors.lanes):
            env = self._smaller(b.add(self.first_env, INT(lane)), self.last_env)
            result = b.insert_element(result, b.load(b.gep(words, [env])), ir.IntType(32)(lane))
        return result

    @contextmanager
    def _repeated(self, times: str) -> Iterator[None]:
        """Repeat the code built inside `with`; a run-time integer gives the number of times."""
        with loop(self.builder, self._run_time_integer(times), "repeat"):
            yield

    def _step(self, step: Step | Repeat) -> None:
        if isinstance(step, Repeat | While):
            with self._repeated(step.times) if isinstance(step, Repeat) else self._while(step.flag):
                for call in step.calls:
                    self._step(call)
        elif isinstance(step, Lookup):
            self._look_up(step)
        elif isinstance(step, Foreign):
            self._call_foreign(step)
        else:
            self._call(step)

    def _run_time_integer(self, name: str) -> Value:
        return self.builder.load(self.builder.gep(self.repeats, [INT(self.layout.repeats.index(name))]))

    def _call_foreign(self, step: Foreign) -> None:
        """Call a function of the caller on the lanes of some buffers."""
        b, pointer = self.builder, FLOATS[self.layout.dtype].as_pointer()
        sizes = {buffer.name: buffer.size for buffer in self.layout.buffers}
        arguments = [self.first_env, self.valid_lanes]
        for name in step.buffers:
            arguments += [b.bitcast(self.lanes[name], pointer), INT(sizes[name])]
        signature = ir.FunctionType(ir.VoidType(), [argument.type for argument in arguments])
        b.call(b.inttoptr(self._run_time_integer(step.function), signature.as_pointer()), arguments)

    @contextmanager
    def _while(self, flag: str) -> Iterator[None]:
        """Repeat the code built inside `with` while a buffer is nonzero in some lane."""
        b = self.builder
        head, body, end = (b.append_basic_block(f"while_{part}") for part in ("head", "body", "end"))
        b.branch(head)
        b.position_at_end(head)
        b.cbranch(self.any_lane(flag), body, end)
        b.position_at_end(body)
        yield
        b.branch(head)
        b.position_at_end(end)

    def _look_up(self, lookup: Lookup) -> None:
        """Emit the look-up of the surface over a table at every point."""
        buffers = {b.name: b for b in self.layout.buffers}
        rows = self.layout.shapes[lookup.table]
        table = Table(self._array(buffers[lookup.table]), self._address(rows), self._address(rows + 1))
        frame, points, output = self.lanes[lookup.frame], self.lanes[lookup.points], self.lanes[lookup.output]
        n_points = buffers[lookup.points].size // 2
        if lookup.grid:
            emit_grid_lookup(self.vectors, table, frame, points, output, n_points - 1, lookup.grid)
            return
        emit = emit_lookup if lookup.slopes else emit_value_lookup
        emit(self.vectors, table, frame, points, output, n_points)

    def _call(self, call: Call) -> None:
        """Call one lowered function, if some lane needs the call."""
        if not call.only_if:
            self._call_variant(call)
            return
        with self.builder.if_then(self.any_lane(call.only_if)):
            self._call_variant(call)

    def _call_variant(self, call: Call) -> None:
        """Call the full function, or those of its parts that some lane needs."""
        split = self._split(call)
        if split is None:
            self._call_body(call)
            return
        if not call.again:
            self._call_parts(call, split, split.first)
        if not call.short_if_zero:
            self._call_parts(call, split, split.parts)
            return
        some_flag = reduce(self.builder.or_, map(self.any_lane, call.short_if_zero))
        with self.builder.if_else(some_flag) as branches:
            for branch, parts in zip(branches, (split.parts, split.short), strict=True):
                with branch:
                    self._call_parts(call, split, parts)

    def _call_parts(self, call: Call, split: Split, parts: Sequence[Part]) -> None:
        """Call parts of a function, or what is executed in their place; of a repeated call those that change."""
        needed = [part for part in parts if not (call.again and part.constant)]
        for flag, same in groupby(needed, lambda part: part.flag):
            group = list(same)
            if flag is None:
                self._call_fragments(call, split, [part.fragment for part in group])
                continue
            with self.builder.if_else(self.any_lane(call.outputs[flag])) as (some, none):
                with some:
                    self._call_fragments(call, split, [part.fragment for part in group])
                with none:
                    self._call_fragments(call, split, [part.skipped for part in group])

    def _split(self, call: Call) -> Split | None:
        """Return the parts of the function; None if the function is called as a whole."""
        changing = self.changing.get(call.function, frozenset())
        if self.parts > 1 or not (changing or call.short_if_zero):
            return None
        key = call.function, _shared(call)
        if key not in self.splits:
            flags = [call.outputs.index(name) for name in call.short_if_zero]
            self.splits[key] = split_function(call.function, changing, flags, _shared(call))
        return self.splits[key]

    def _call_fragments(self, call: Call, split: Split, fragments: Sequence[Fragment]) -> None:
        for fragment in fragments:
            if not fragment.is_empty:
                inputs, outputs = arguments_of(call.function, fragment)
                names = [*(call.inputs[i] for i in inputs), *(call.outputs[i] for i in outputs)]
                pointers = [self.lanes[name] for name in names]
                self.builder.call(self._body(call, fragment), [*pointers, self._kept(split)])

    def _kept(self, split: Split) -> Value:
        """Return the memory for the values that parts of a function keep for each other, for one tile."""
        if split not in self.kept:
            with self.builder.goto_entry_block():
                self.kept[split] = self.builder.alloca(self.vectors.float_type, INT(max(split.size, 1)))
            self.kept[split].align = ALIGNMENT
        return self.kept[split]

    def _call_body(self, call: Call) -> None:
        """Call the whole function for every part of the lanes, and `times` for parts of the buffers."""
        b, parts, f, body = self.builder, self.parts, call.function, self._body(call)
        pointers = [self.lanes[name] for name in call.inputs + call.outputs]
        if parts == call.times == 1:
            b.call(body, pointers)
            return
        sizes = {buffer.name: buffer.size for buffer in self.layout.buffers}
        numel = [f.numel_in(i) for i in range(f.n_in())] + [f.numel_out(i) for i in range(f.n_out())]
        advances = [sizes[name] > n for name, n in zip(call.inputs + call.outputs, numel, strict=True)]
        narrow = [b.bitcast(pointer, argument.type) for pointer, argument in zip(pointers, body.args, strict=True)]
        with loop(b, INT(call.times), "time") as time, loop(b, INT(parts), "part") as part:
            first = [
                b.mul(time, INT(n * parts)) if advance else INT(0) for n, advance in zip(numel, advances, strict=True)
            ]
            b.call(body, [b.gep(pointer, [b.add(at, part)]) for pointer, at in zip(narrow, first, strict=True)])

    def _body(self, call: Call, fragment: Fragment | None = None) -> ir.Function:
        """Return the LLVM function of a function or a fragment; it is emitted at its first use."""
        shared = _shared(call) if fragment else frozenset()
        key = call.function, shared, fragment
        if key not in self.bodies:
            self.bodies[key] = self._emitted(call.function, shared, fragment)
        return self.bodies[key]

    def _emitted(self, function: casadi.Function, shared: Pairs, fragment: Fragment | None) -> ir.Function:
        """Return a function or a fragment as one long block that the optimiser sees alone."""
        pointer = VectorBuilder(None, self.layout.dtype, self.parts).float_type.as_pointer()
        numbers = range(function.n_in()), range(function.n_out())
        reads, writes = arguments_of(function, fragment) if fragment else numbers
        count = len(reads) + len(writes) + (fragment is not None)
        signature = ir.FunctionType(ir.VoidType(), [pointer] * count)
        body = ir.Function(self.builder.module, signature, f"call_{len(self.bodies)}")
        body.linkage = "internal"
        body.attributes.add("noinline")
        body.attributes.alignstack = ALIGNMENT  # else spilled vectors straddle two cache lines each
        vectors = VectorBuilder(ir.IRBuilder(body.append_basic_block("entry")), self.layout.dtype, self.parts)
        inputs = dict(zip(reads, body.args, strict=False))
        outputs = dict(zip(writes, body.args[len(reads) :], strict=False))
        disjoint = self.program.compact and self._is_disjoint(function)
        kept = body.args[-1] if fragment else None
        lower_function(vectors, function, Arguments(inputs, outputs, kept, disjoint, shared), fragment)
        vectors.builder.ret_void()
        return body

    def _is_disjoint(self, function: casadi.Function) -> bool:
        """Return whether no call of a function overwrites its inputs."""
        calls = [call for call in self.program.calls if isinstance(call, Call) and call.function is function]
        roots = {b.name: b.within or b.name for b in self.program.buffers}
        return not any({roots[x] for x in call.inputs} & {roots[x] for x in call.outputs} for call in calls)

    def _smaller(self, a: Value, b: Value) -> Value:
        return self.builder.select(self.builder.icmp_signed("<", a, b), a, b)


def _changing(call: Call) -> frozenset[int]:
    """Return the numbers of the inputs that may have changed since the previous call."""
    return frozenset(call.inputs.index(name) for name in call.again)


def _shared(call: Call) -> Pairs:
    """Return the pairs of an input and an output of a call that are one buffer."""
    pairs = ((i, j) for i, name in enumerate(call.inputs) for j, to in enumerate(call.outputs) if name == to)
    return frozenset(pairs)


def _convert(builder: Builder, value: Value, to: ir.Type) -> Value:
    """Return a float in the given precision."""
    if value.type == to:
        return value
    wider = getattr(to, "element", to) == FLOATS["float64"]
    return builder.fpext(value, to) if wider else builder.fptrunc(value, to)
