# Sourced by the other scripts: makes .venv where it is missing and installs what is asked for.
# Needs Python 3.11 or newer and its venv module, nothing else.

find_python() {
    for candidate in "${PYTHON:-python3}" python3.13 python3.12 python3.11; do
        if "$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then
            echo "$candidate"
            return
        fi
    done
    echo "Python 3.11 or newer is needed; set PYTHON to it." >&2
    exit 1
}

# setup [EXTRAS]: installs meshreg[EXTRAS] in .venv, unless that was done for this pyproject.toml.
setup() {
    if [ ! -x .venv/bin/python ]; then
        python=$(find_python)
        if ! "$python" -m venv .venv; then
            rm -rf .venv
            echo "The venv module is missing: apt-get install python3-venv" >&2
            exit 1
        fi
    fi
    extras=${1:-}
    stamp=.venv/.installed-$extras
    if ! cmp -s pyproject.toml "$stamp"; then
        echo "installing into .venv (some minutes the first time)" >&2
        .venv/bin/python -m pip install --quiet --disable-pip-version-check -e ".${extras:+[$extras]}"
        cp pyproject.toml "$stamp"
    fi
}
