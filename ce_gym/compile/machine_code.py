"""Compile LLVM code to object code for this CPU, and load object code as a function."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable
from functools import cache

from llvmlite import binding, ir

from ce_gym.compile.layout import MachineCode
from ce_gym.compile.lowering.vector import Builder, Value, loop

Emit = Callable[[Builder, tuple[Value, ...]], None]
"""Emits the work on one tile. Takes the builder, the three addresses of `MachineCode`, the number of the tile and the
number of environments."""

ENTRY = "run"
OPTIMISATION = 3
"""Optimisation level of the passes of LLVM."""
LONG = 8_000_000
"""Characters of code in the language of LLVM above which most passes are left out, to save a fifth of the time."""
GENERATION = 1
"""Optimisation level of code generation. At higher levels, LLVM reorders instructions again during register allocation
on some CPUs, which doubles the compile time and makes no kernel faster."""


@cache
def host_cpu() -> tuple[str, str]:
    """Return name and features of the CPU of this machine in terms of LLVM; kernels are compiled for this CPU."""
    return binding.get_host_cpu_name(), binding.get_host_cpu_features().flatten()


@cache
def registers_per_vector() -> int:
    """Return the number of registers of this CPU that hold 64 bytes."""
    features = host_cpu()[1].split(",")
    return 1 if "+avx512f" in features else 2 if "+avx" in features else 4


def compile_object(emit: Emit, thorough: bool = True) -> bytes:
    """Compile the loop over tiles.

    Args:
        emit: emits the body of the loop.
        thorough: whether to run all passes of LLVM, unless the code is `LONG`, or only instruction combining. In long
            functions without branches the other passes find little and take as long as register allocation.

    Returns:
        An object file that defines the one function `run`.
    """
    machine = _target_machine()
    text = str(_loop_over_tiles(emit))
    module = binding.parse_assembly(text)
    module.verify()
    tuning = binding.create_pipeline_tuning_options(speed_level=OPTIMISATION)
    tuning.loop_vectorization = tuning.slp_vectorization = False  # the code is made of vectors already
    passes = binding.create_pass_builder(machine, tuning)
    if thorough and len(text) < LONG:
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
    """Return object code of `compile_object` as a function whose calls release the GIL.

    The code stays in memory until the process ends, because a thread may still run the code at exit.
    """
    jit = binding.create_lljit_compiler(_target_machine(), use_jit_link=True)
    builder = binding.JITLibraryBuilder().add_object_img(code).add_current_process().export_symbol(ENTRY)
    library = builder.link(jit, "kernel")
    run = ctypes.CFUNCTYPE(None, *[ctypes.c_int64] * 6)(library[ENTRY])
    library.detach()
    jit.detach()
    return run


def add_symbol(name: str, code: MachineCode) -> None:
    """Let other code that LLVM compiles in this process call a function of `load_object` by name."""
    binding.add_symbol(name, ctypes.cast(code, ctypes.c_void_p).value)  # type: ignore[arg-type]


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
    """Return the target triple of this machine; LLVM links ELF objects in memory on Windows, too."""
    return binding.get_process_triple() + ("-elf" if os.name == "nt" else "")


def _target_machine() -> binding.TargetMachine:
    """Return the LLVM target of this CPU; the code model is small, as the linker puts code and constants together."""
    binding.initialize_native_target()
    binding.initialize_native_asmprinter()
    cpu, features = host_cpu()
    return binding.Target.from_triple(_triple()).create_target_machine(
        cpu, features, GENERATION, reloc="pic", codemodel="small", jit=True
    )
