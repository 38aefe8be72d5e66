#!/bin/sh
# Makes .venv ready to run and test this project: pinned Python packages, the project itself, and
# LLVM for Mitsuba. Needs Python 3.11 or later. What else is missing it installs through apt where
# it may (as root, or by sudo without a password); elsewhere it stops with the one command to type.
# Run it as often as you like: with nothing to do it ends at once.
set -eu
cd "$(dirname "$0")/.."

say() { echo "setup: $*" >&2; }
stop() { say "$*"; exit 1; }

# The folder is part of the stamp, because the programs in .venv/bin name the folder they lie in.
wanted="$(cat deploy/bootstrap.sh deploy/requirements.lock pyproject.toml | cksum) $PWD"
if [ -x .venv/bin/python ] && [ "$(cat .venv/setup-stamp 2>/dev/null)" = "$wanted" ]; then
    exit 0
fi

as_root() {
    if [ "$(id -u)" = 0 ]; then "$@"; else sudo -n "$@"; fi
}

# Installs through apt where that may be done. New package lists are fetched only where the present ones do not do.
apt_install() {
    command -v apt-get >/dev/null && as_root true 2>/dev/null || return 1
    say "installing $*"
    set -- as_root env DEBIAN_FRONTEND=noninteractive apt-get -qq --yes install --no-install-recommends "$@"
    "$@" >/dev/null 2>&1 || { as_root apt-get -qq update && "$@" >/dev/null; }
}

find_python() {
    for candidate in ${PYTHON:-python3 python3.13 python3.12 python3.11}; do
        "$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo "$candidate" && return
    done
    return 1
}

# What of the system is missing, by the names of its packages.
missing_packages() {
    # Debian and Ubuntu keep a part of the venv module in a package of its own.
    "$python" -c 'import ensurepip, venv' 2>/dev/null || echo "$(basename "$python")-venv"
    "$python" -c 'from elps_core import device; print(*device.missing_packages())'
}

python=$(find_python) || stop "Python 3.11 or later is needed: install it, or name it with PYTHON=..., and run this again"
missing=$(missing_packages | xargs)
if [ -n "$missing" ]; then
    # LLVM 19 is what we test with; 18 and 17 (under the name that Ubuntu 24.04 gives it) work as well.
    for llvm in libllvm19 libllvm18 libllvm17t64; do
        # shellcheck disable=SC2046  # each package is a word
        apt_install $(echo "$missing" | sed "s/libllvm19/$llvm/") && break
    done
    missing=$(missing_packages | xargs)
fi
if [ -n "$missing" ]; then
    # shellcheck disable=SC2086  # each package is a word
    stop "type '$("$python" -c 'import sys; from elps_core import device; print(device.install_command(sys.argv[1:]))' \
        $missing)', then run this again"
fi

# A folder that was moved or copied, and a Python that was replaced, need .venv anew.
if ! { grep -qsF "$PWD/.venv/bin/python" .venv/bin/pip && .venv/bin/python -c 'import pip' 2>/dev/null; }; then
    say "creating .venv"
    "$python" -m venv --clear .venv
fi
say "installing the pinned Python packages (a minute or two)"
pip() { .venv/bin/python -m pip --quiet --disable-pip-version-check "$@"; }
pip install --no-deps --require-hashes --only-binary :all: --requirement deploy/requirements.lock
pip install --no-deps --no-build-isolation --editable .

.venv/bin/python -c '
import sys
from elps_core import device, errors
try:
    device.use("llvm_ad_rgb")
except errors.DeviceUnavailable as problem:
    sys.exit(f"setup: {problem}")'
echo "$wanted" >.venv/setup-stamp
say "done"
