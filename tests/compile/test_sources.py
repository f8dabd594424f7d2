"""What kernels' names depend on."""

import pytest

from ce_gym.compile import loading, machine_code, source_fingerprint, sources


def test_fingerprint_follows_the_sources(tmp_path, monkeypatch):
    package = tmp_path / "some_package"
    (package / "inner").mkdir(parents=True)
    for name in ("__init__.py", "alone.py", "inner/__init__.py", "inner/thing.py"):
        (package / name).write_text("x = 1\n")
    monkeypatch.syspath_prepend(tmp_path)
    names = "some_package", "some_package.inner", "some_package.alone"
    before = [source_fingerprint(name) for name in names]
    source_fingerprint.cache_clear()
    assert [source_fingerprint(name) for name in names] == before
    (package / "inner" / "thing.py").write_text("x = 2\n")
    source_fingerprint.cache_clear()
    after = [source_fingerprint(name) for name in names]
    assert [a != b for a, b in zip(after, before, strict=True)] == [True, True, False]
    assert len({*before, *after}) == 5
    with pytest.raises(ValueError, match="module 'no_such_package': not found"):
        source_fingerprint("no_such_package")


def test_names_follow_all_that_compiles(monkeypatch):
    names = [loading.kernel_name(*facts) for facts in (("k", "float64"), ("k", "float32"), ("l", "float64"))]
    monkeypatch.setattr(machine_code, "host_cpu", lambda: ("haswell", ""))
    names.append(loading.kernel_name("k", "float64"))
    monkeypatch.setattr(sources, "version", lambda package: "0.0")
    sources.toolchain.cache_clear()
    names.append(loading.kernel_name("k", "float64"))
    sources.toolchain.cache_clear()
    assert len(set(names)) == 5
