"""LLVM code to object code for this CPU, and object code to a function."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable
from functools import cache

from llvmlite import binding, ir

from ce_gym.compile.layout import MachineCode
from ce_gym.compile.lowering.vector import Builder, Value, loop

Emit = Callable[[Builder, tuple[Value, ...]], None]
"""Emits the work on one tile: takes the builder and, for `MachineCode`'s arguments, those three addresses, the number
of the tile and that of environments."""

ENTRY = "run"
OPTIMISATION = 3
"""Of LLVM's passes."""
GENERATION = 1
"""Of instructions: above it, on some CPUs, LLVM orders them once more when registers are given out. That takes as long
as all the rest, and makes nothing faster."""


@cache
def host_cpu() -> tuple[str, str]:
    """Name and features of this machine's CPU, as LLVM has them; kernels are compiled for it."""
    return binding.get_host_cpu_name(), binding.get_host_cpu_features().flatten()


@cache
def registers_per_vector() -> int:
    """Return how many of this CPU's registers 64 bytes take."""
    features = host_cpu()[1].split(",")
    return 1 if "+avx512f" in features else 2 if "+avx" in features else 4


def compile_object(emit: Emit, thorough: bool = True) -> bytes:
    """Compile the loop over tiles.

    Args:
        emit: emits its body.
        thorough: whether all of LLVM's passes are run, or only the one that simplifies instruction by instruction. In
            long functions without branches the others find little and take as long as giving out registers.

    Returns:
        An object file that defines the one function `run`.
    """
    machine = _target_machine()
    module = binding.parse_assembly(str(_loop_over_tiles(emit)))
    module.verify()
    tuning = binding.create_pipeline_tuning_options(speed_level=OPTIMISATION)
    tuning.loop_vectorization = tuning.slp_vectorization = False  # the code is made of vectors already
    passes = binding.create_pass_builder(machine, tuning)
    if thorough:
        passes.getModulePassManager().run(module, passes)
    else:
        _simplify(module, passes)
    return machine.emit_object(module)


def _simplify(module: binding.ModuleRef, passes: binding.PassBuilder) -> None:
    manager = binding.create_new_function_pass_manager()
    manager.add_instruction_combine_pass()
    for function in module.functions:
        if not function.is_declaration:
            manager.run(function, passes)


def load_object(code: bytes) -> MachineCode:
    """Make what `compile_object` returned callable; calls release the GIL.

    It stays in memory until the process ends: a thread may be running it when everything else is taken down.
    """
    jit = binding.create_lljit_compiler(_target_machine(), use_jit_link=True)
    builder = binding.JITLibraryBuilder().add_object_img(code).add_current_process().export_symbol(ENTRY)
    library = builder.link(jit, "kernel")
    run = ctypes.CFUNCTYPE(None, *[ctypes.c_int64] * 6)(library[ENTRY])
    library.detach()
    jit.detach()
    return run


def _loop_over_tiles(emit: Emit) -> ir.Module:
    module, word = ir.Module("kernel"), ir.IntType(64)
    module.triple = _triple()
    function = ir.Function(module, ir.FunctionType(ir.VoidType(), [word] * 6), ENTRY)
    table, repeats, scratch, first_tile, end_tile, num_envs = function.args
    builder: Builder = ir.IRBuilder(function.append_basic_block("entry"))
    with loop(builder, builder.sub(end_tile, first_tile), "tile") as index:
        emit(builder, (table, repeats, scratch, builder.add(first_tile, index), num_envs))
    builder.ret_void()
    return module


def _triple() -> str:
    """The machine's triple; with ELF objects on Windows too, which LLVM links in memory like those of Linux."""
    return binding.get_process_triple() + ("-elf" if os.name == "nt" else "")


def _target_machine() -> binding.TargetMachine:
    """What compiles for this CPU. Code and constants lie close together: the linker puts them into one block."""
    binding.initialize_native_target()
    binding.initialize_native_asmprinter()
    cpu, features = host_cpu()
    return binding.Target.from_triple(_triple()).create_target_machine(
        cpu, features, GENERATION, reloc="pic", codemodel="small", jit=True
    )
