"""Files made to harm: each is one line, soon, and within a limit on memory. Policies and rollouts share the reader."""

from __future__ import annotations

import contextlib
import io
import json
import os
import resource
import struct
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from stander import record, stander, write_small, write_zip

from ce_gym.model.formats.archive import MOST_BYTES
from ce_gym.policies import PolicyError, find_policy, load_policy
from ce_gym.viewer import Rollout, RolloutError


def npy(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def header(shape: tuple[int, ...], dtype: str = "<f4") -> bytes:
    """A npy file of that shape, but for its numbers."""
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": dtype, "fortran_order": False, "shape": shape})
    return stream.getvalue()


def npz(file: Path, **members: bytes) -> Path:
    """A policy.npz with some members replaced."""
    layers = stander().layers
    usual = {f"weight_{i}": npy(weight) for i, (weight, _) in enumerate(layers)}
    usual |= {f"bias_{i}": npy(bias) for i, (_, bias) in enumerate(layers)}
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in (usual | {"record": npy(np.array(json.dumps(record())))} | members).items():
            archive.writestr(f"{name}.npy", data)
    return file


def refused(file: Path, words: str) -> None:
    for read, kind in ((load_policy, PolicyError), (Rollout.load, RolloutError)):
        with pytest.raises(kind) as caught:
            read(file)
        message = str(caught.value)
        assert message.startswith(str(file))
        assert message.isprintable()
        assert len(message) < len(str(file)) + 400
    with pytest.raises(PolicyError, match=words):
        load_policy(file)


def test_the_usual_one_is_read(tmp_path: Path) -> None:
    assert load_policy(npz(tmp_path / "policy.npz")).record == record()


def test_headers_that_promise_terabytes(tmp_path: Path) -> None:
    file = npz(tmp_path / "policy.npz", weight_0=header((2**22, 2**21)), header=header((2**22, 2**21)))
    refused(file, "takes 35184372088832 bytes; found 0")


def bomb(file: Path, name: str) -> Path:
    """A small zip whose only member unpacks to more than is read."""
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive, archive.open(name, "w") as out:
        for _ in range(MOST_BYTES // 2**22 + 1):
            out.write(bytes(2**22))
    return file


def test_small_files_that_unpack_to_gigabytes(tmp_path: Path) -> None:
    file = bomb(tmp_path / "policy.npz", "record.npy")
    assert file.stat().st_size < MOST_BYTES / 200
    refused(file, f"bytes unpacked; expected at most {MOST_BYTES}")
    lie(file, 1000)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    refused(file, "Bad CRC-32")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000  # KiB: it was not unpacked


def lie(file: Path, size: int) -> None:
    """Change the size that the table of contents states for its first entry."""
    data = bytearray(file.read_bytes())
    at = data.index(b"PK\x01\x02") + 24
    data[at : at + 4] = struct.pack("<I", size)
    file.write_bytes(data)


def test_a_zip_in_a_zip_that_unpacks_to_gigabytes(tmp_path: Path) -> None:
    file = write_zip(tmp_path)
    bomb(file, "policy.pth")
    with pytest.raises(PolicyError, match=r"policy\.pth: .* bytes unpacked; expected at most"):
        load_policy(file)


@pytest.mark.parametrize("number", [np.nan, np.inf, -np.inf])
def test_weights_that_are_no_numbers(tmp_path: Path, number: float) -> None:
    bias = np.zeros(12, np.float32)
    bias[3] = number
    refused(npz(tmp_path / "policy.npz", bias_1=npy(bias)), "a weight is NaN or infinite")


@pytest.mark.parametrize(
    "array", [np.array("text"), np.zeros((), np.float32), np.zeros((2, 2, 2), np.float32), np.zeros((8, 48), int)]
)
def test_weights_that_are_no_layer(tmp_path: Path, array: np.ndarray) -> None:
    refused(npz(tmp_path / "policy.npz", weight_0=npy(array)), "expected a layer's numbers along 2 axes")


NESTED = "[" * 100_000 + "]" * 100_000


def test_records_nested_without_end(tmp_path: Path) -> None:
    refused(npz(tmp_path / "policy.npz", record=npy(np.array(NESTED)), header=npy(np.array(NESTED))), "recursion")
    file = write_zip(tmp_path)
    file.with_suffix(".json").write_text(NESTED, encoding="utf-8")
    with pytest.raises(PolicyError, match=r"policy\.json: cannot be read as JSON: .*recursion"):
        load_policy(file)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"env": ["a"]}, "env: .*expected text"),
        ({"env_kwargs": "x"}, "env_kwargs: 'x'; expected a JSON object"),
        ({"activation": []}, r"activation: \[\]; expected text"),
        ({"observation_size": 48.0}, "observation_size: 48.0; expected a whole number"),
        ({"action_size": True}, "action_size: True; expected a whole number"),
        ({"policy_spec": None}, "policy_spec: None; expected a JSON object"),
        ({"activation": "\x1b[2J" + 999 * "x"}, r"activation: '\\x1b\[2Jxx"),
    ],
)
def test_records_of_other_kinds(tmp_path: Path, changes: dict, words: str) -> None:
    with pytest.raises(PolicyError, match=rf"policy\.npz: {words}") as caught:
        load_policy(write_small(tmp_path / "policy.npz", **changes))
    assert len(str(caught.value)) < len(str(tmp_path)) + 400


def test_records_that_are_no_files(tmp_path: Path) -> None:
    """A pipe would make the reader wait for ever, a device never end."""
    file = write_zip(tmp_path)
    file.with_suffix(".json").unlink()
    os.mkfifo(file.with_suffix(".json"))
    with pytest.raises(PolicyError, match="not a regular file"):
        load_policy(file)
    os.mkfifo(tmp_path / "pipe.npz")
    assert find_policy(tmp_path / "pipe.npz") is None
    with pytest.raises(RolloutError, match="not a regular file"):
        Rollout.load(tmp_path / "pipe.npz")


def test_encrypted_and_unusually_packed_files(tmp_path: Path) -> None:
    file = npz(tmp_path / "policy.npz")
    data = bytearray(file.read_bytes())
    for signature, flags in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        at = -1
        while (at := data.find(signature, at + 1)) >= 0:
            data[at + flags] |= 1
    file.write_bytes(data)
    refused(file, "encrypted")
    with zipfile.ZipFile(file, "w", zipfile.ZIP_LZMA) as archive:
        archive.writestr("record.npy", npy(np.zeros(3)))
    refused(file, "compression 14; expected none or deflate")


@pytest.mark.parametrize("path", ["", ".", "..", "/", "a\0b", "x" * 5000, "policy.npz/policy.npz"])
def test_paths_that_are_none(path: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(PolicyError, match="no such policy"):
        load_policy(path)


MUTANTS = 400


def test_random_damage_is_one_line(tmp_path: Path) -> None:
    """Bytes changed, cut and doubled at random; what can still be read is a policy."""
    rng = np.random.default_rng(0)
    small = npz(tmp_path / "policy.npz")
    both = (small, write_zip(tmp_path / "run"))
    whole = [file.read_bytes() for file in both]
    for i in range(MUTANTS):
        file, data = both[i % 2], bytearray(whole[i % 2])
        for _ in range(rng.integers(1, 6)):
            at = int(rng.integers(len(data)))
            how = rng.integers(3)
            if how == 0:
                data[at] = int(rng.integers(256))
            elif how == 1:
                del data[at : at + int(rng.integers(1, 40))]
            else:
                data[at:at] = data[at : at + int(rng.integers(1, 40))]
        file.write_bytes(data)
        with contextlib.suppress(PolicyError):
            assert load_policy(file).predict(np.zeros(48))[0].shape == (12,)


def test_reading_imports_nothing(tmp_path: Path) -> None:
    """A record's names are names: no module is imported because a file says so."""
    (tmp_path / "trap.py").write_text("open('sprung', 'w')")
    file = write_small(tmp_path / "policy.npz", env="trap:Trap-v0")
    code = "import sys; sys.path.insert(0, '.'); import ce_gym; ce_gym.load_policy(sys.argv[1])"
    subprocess.run([sys.executable, "-c", code, file], cwd=tmp_path, check=True)
    assert not (tmp_path / "sprung").exists()
