#!/usr/bin/env bash
# The package on 64-bit Arm, emulated: some of its tests, then digests of this machine's results compared with Arm's.
#
#   tests/arm.sh [ARGUMENTS OF digests]      by default --quick: an hour or two, nearly all of it compilation
#
# Needs a Debian-like Linux with apt-get, and a .venv (`make venv`). Everything is downloaded by name, by apt-get and pip
# as they are set up, unpacked into build/arm and kept there; nothing is installed and no rights are needed. QEMU runs
# Debian's Python for Arm and PyPI's wheels for Arm, in the versions that .venv has.
set -euo pipefail
cd "$(dirname "$0")/.."
BIN=$PWD/.venv/bin ARM=$PWD/build/arm
PACKAGES="numpy casadi llvmlite gymnasium PyYAML pytest hypothesis"
TESTS="tests/compile/test_math.py tests/compile/test_random.py tests/compile/test_lookup.py tests/dynamics/test_vectors.py"
DIGESTS=("${@:---quick}")

debian() {  # architecture, packages: these and what they depend on, unpacked into build/arm/<architecture>
    local state="$ARM/apt-$1"
    local get=(apt-get --quiet --quiet --yes --no-install-recommends -o "APT::Architecture=$1" -o "APT::Architectures=$1"
        -o "Dir::State=$state/state" -o "Dir::Cache=$state/cache" -o "Dir::State::status=$state/status"
        -o APT::Sandbox::User=)
    mkdir -p "$state/state/lists/partial" "$state/cache/archives/partial" "$ARM/$1"
    : > "$state/status"
    "${get[@]}" update
    "${get[@]}" --download-only install "${@:2}"
    for package in "$state"/cache/archives/*.deb; do dpkg-deb --extract "$package" "$ARM/$1"; done
}

install_arm() {
    debian arm64 python3 libstdc++6 libgomp1
    debian "$(dpkg --print-architecture)" qemu-user-static
    local version
    version=$(cd "$ARM/arm64/usr/lib" && ls -d python3.* | sed s/python//)
    "$BIN/python" -m pip freeze | grep -iE "^($(tr ' ' '|' <<< "$PACKAGES"))==" > "$ARM/versions.txt"
    "$BIN/python" -m pip install --quiet --upgrade --target "$ARM/site" --python-version "$version" --only-binary=:all: \
        --platform manylinux_2_17_aarch64 --platform manylinux2014_aarch64 --platform manylinux_2_28_aarch64 \
        --requirement "$ARM/versions.txt"
    touch "$ARM/installed"
}

[ -e "$ARM/installed" ] || install_arm

on_arm() {  # arguments of Python
    PYTHONPATH="$PWD:$ARM/site" CE_GYM_CACHE_DIR="$ARM/kernels" \
        "$ARM/$(dpkg --print-architecture)/usr/bin/qemu-aarch64-static" -L "$ARM/arm64" "$ARM/arm64/usr/bin/python3" "$@"
}

on_arm -c 'import platform; print("Python", platform.python_version(), "on", platform.machine())'
# shellcheck disable=SC2086
on_arm -m pytest -p no:cacheprovider -k "not cuda" $TESTS
"$BIN/python" -m ce_gym.bench digests "${DIGESTS[@]}" --out "$ARM/here.json" > /dev/null
on_arm -m ce_gym.bench digests "${DIGESTS[@]}" --against "$ARM/here.json"
