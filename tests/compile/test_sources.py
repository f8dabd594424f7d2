"""What kernels' names depend on."""

import pytest

from ce_gym.compile import source_fingerprint


def test_fingerprint_follows_the_sources(tmp_path, monkeypatch):
    package = tmp_path / "some_package"
    (package / "inner").mkdir(parents=True)
    (package / "__init__.py").write_text("")
    (package / "inner" / "thing.py").write_text("x = 1\n")
    monkeypatch.syspath_prepend(tmp_path)
    before = source_fingerprint("some_package")
    source_fingerprint.cache_clear()
    assert source_fingerprint("some_package") == before
    (package / "inner" / "thing.py").write_text("x = 2\n")
    source_fingerprint.cache_clear()
    assert source_fingerprint("some_package") != before
    with pytest.raises(ValueError, match="package 'no_such_package': not found"):
        source_fingerprint("no_such_package")
