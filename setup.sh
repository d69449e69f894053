#!/bin/sh
# Finds a Python 3.12 or 3.13, makes .venv with it and installs the project there at pinned versions.
#   ./setup.sh                 install; run again whenever pyproject.toml or constraints.txt change
#   ./setup.sh --find-python   only print the interpreter that would be used
#   PYTHON=/path/to/python3.12 ./setup.sh
set -eu
cd "$(dirname "$0")"

usable() {
    # A pyenv shim exists for versions that are not active and then fails, so run it. Debian keeps
    # ensurepip, which venv needs, in a package of its own.
    [ -x "$1" ] && "$1" -c '
import ensurepip, sys, venv
sys.exit(not (3, 12) <= sys.version_info[:2] <= (3, 13))' >/dev/null 2>&1
}

# The pinned versions were resolved on 3.12, so that comes first; LeRobot needs a NumPy that has no
# wheel for 3.14.
candidates() {
    for version in 3.12 3.13 3 ''; do
        (
            IFS=:
            for folder in $PATH; do echo "$folder/python$version"; done
        )
    done
    for version in 3.12 3.13; do
        for python in "${PYENV_ROOT:-$HOME/.pyenv}/versions/$version"*/bin/python3; do
            echo "$python"
        done
    done
    if command -v uv >/dev/null 2>&1; then
        UV_PYTHON_DOWNLOADS=never uv python find --no-project '>=3.12,<3.14' 2>/dev/null || true
    fi
}

find_python() {
    if [ -n "${PYTHON:-}" ]; then
        chosen=$(command -v "$PYTHON" || true)
        if usable "$chosen"; then
            echo "$chosen"
            return
        fi
        echo "error: PYTHON=$PYTHON is not a Python 3.12 or 3.13 with the venv module" >&2
        return 1
    fi
    candidates | {
        while read -r python; do
            if usable "$python"; then
                echo "$python"
                exit 0
            fi
        done
        cat >&2 <<'MESSAGE'
error: no Python 3.12 or 3.13 with the venv module was found on PATH, among pyenv's versions or by
uv. Install one, then run this again:
    Debian, Ubuntu   apt install python3.12 python3.12-venv   (python3.13 on Debian 13)
    Fedora           dnf install python3.12
    macOS            brew install python@3.12
    pyenv            pyenv install 3.12
    uv               uv python install 3.12
or name one that is elsewhere:  make install PYTHON=/path/to/python3.12
MESSAGE
        exit 1
    }
}

if [ "${1:-}" = --find-python ]; then
    find_python
    exit
fi

# Without pip it was made by uv, or never made to the end.
if ! usable .venv/bin/python || ! .venv/bin/python -m pip --version >/dev/null 2>&1; then
    python=$(find_python)
    echo "Making .venv with $python"
    "$python" -m venv --clear .venv
fi
echo "Installing into .venv; the first time takes some minutes, most of them for PyTorch"
quiet=--quiet
[ -t 1 ] && quiet=
.venv/bin/python -m pip install $quiet --disable-pip-version-check \
    --constraint constraints.txt --editable '.[dev]'
touch .venv/.installed
