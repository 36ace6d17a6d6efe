#!/bin/sh
# Installs a wheel into a fresh environment and runs the tests against it, outside the checkout.
#   sh tests/check_wheel.sh PYTHON DIST [pytest arguments]
# VERSIONS="torch==2.11.0 numpy==1.26.0 ..." puts other versions than those of constraints.txt to the test.
set -eu
python=$1
dist=$(cd "$2" && pwd)
shift 2
root=$(cd "$(dirname "$0")/.." && pwd)
wheel=$(ls -t "$dist"/torchrl_sspl-*.whl | head -n 1)
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

"$python" -m venv "$work/venv"
if [ -n "${VERSIONS:-}" ]; then
    # shellcheck disable=SC2086
    "$work/venv/bin/pip" install --quiet --disable-pip-version-check "$wheel[test]" $VERSIONS
else
    "$work/venv/bin/pip" install --quiet --disable-pip-version-check -c "$root/constraints.txt" "$wheel[test]"
fi
"$work/venv/bin/pip" check

# What the tests read, without the package itself.
mkdir "$work/checkout"
for part in tests examples benchmarks docs README.md CHANGELOG.md pyproject.toml; do
    cp -r "$root/$part" "$work/checkout/"
done
cd "$work/checkout"
place=$("$work/venv/bin/python" -c "import torchrl_sspl; print(torchrl_sspl.__file__)")
case $place in
    "$work"/venv/*) echo "tests run against $place" ;;
    *) echo "expected the installed wheel, found $place" >&2 && exit 1 ;;
esac
"$work/venv/bin/python" -m pytest -p no:cacheprovider -m "not slow and not gpu and not ray" "$@"
