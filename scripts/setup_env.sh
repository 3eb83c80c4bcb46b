#!/usr/bin/env bash
# Make or refresh the environment: scripts/setup_env.sh <environment folder>
# Does nothing when nothing changed. Several clones may share one environment; the editable install then points to the
# clone that ran this last.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
env="${1:?usage: scripts/setup_env.sh <environment folder>}"
python="${PYTHON:-python3}"
opencv="opencv-contrib-python-headless"

fail() {
  echo "beags setup: $1" >&2
  exit 1
}

digest() { # of the contents and names of the files given on standard input, one a line
  sort | while IFS= read -r file; do
    if [ -f "$file" ]; then sha256sum "$file"; fi
  done | sha256sum | cut -d' ' -f1
}

if [ ! -x "$env/bin/python" ]; then
  command -v "$python" >/dev/null || fail "there is no $python: install Python 3.10 to 3.12 (Debian: apt install python3 python3-venv), or name one with PYTHON=..."
  "$python" -c 'import sys; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 12))' ||
    fail "$python is $("$python" -V 2>&1), but nerfstudio's dependencies need Python 3.10 to 3.12: name another with PYTHON=..."
  "$python" -c 'import venv, ensurepip' 2>/dev/null || fail "$python cannot make environments: install its venv module (Debian: apt install python3-venv)."
fi
compiler="${CXX:-}"
for candidate in c++ g++ clang++; do
  if [ -z "$compiler" ] && command -v "$candidate" >/dev/null; then compiler="$candidate"; fi
done
# CXX may hold options after the command; only its first word must exist.
{ [ -n "$compiler" ] && command -v "${compiler%% *}" >/dev/null; } ||
  fail "there is no C++ compiler: install one (Debian: apt install g++), or name one with CXX=..."

mkdir -p "$env"
env="$(cd "$env" && pwd)"
if command -v flock >/dev/null; then # clones that share the environment take turns
  exec 9>"$env/.beags-lock"
  flock 9
fi
if [ ! -x "$env/bin/python" ]; then
  echo "beags setup: making the environment $env (a few minutes, about 8 GB)"
  "$python" -m venv "$env"
fi

packages_now="$(printf '%s\n' constraints.txt pyproject.toml | digest)"
source_now="$(pwd) $({
  printf '%s\n' pyproject.toml CMakeLists.txt
  printf '%s\n' cmake/cuda.cmake
  find beags_plugin -type f -name '*.[ch]*' ! -name '*.pyc'
} | digest) $(find beags_plugin -name '*.py' | sort | sha256sum | cut -c1-16)"
# Distributions beside beags that join it by entry points; a module of theirs is found wherever it lies in its folder.
joined=()
for folder in baselines benchmarks; do
  if [ -f "$folder/pyproject.toml" ]; then joined+=("$folder"); fi
done
joined_now="$(pwd) $(printf '%s/pyproject.toml\n' "${joined[@]}" | digest)"
joined_before="$(cat "$env/.beags-joined" 2>/dev/null || true)"
# The editable install maps every module to its file, so a module that moved needs a new one.
packages_before="$(cat "$env/.beags-packages" 2>/dev/null || true)"
source_before="$(cat "$env/.beags-source" 2>/dev/null || true)"

# The kernels for GPUs are compiled for the GPU that is here; where there is none, for the oldest and the newest that
# are supported, to see that they compile. Their emulation on the CPU is for the tests.
architectures="${BEAGS_CUDA_ARCHITECTURES:-75-real;90}"
if [ -z "${BEAGS_CUDA_ARCHITECTURES:-}" ] && nvidia-smi -L >/dev/null 2>&1; then architectures=native; fi
build=(-C "cmake.define.BEAGS_CUDA_ARCHITECTURES=$architectures" -C cmake.define.BEAGS_CUDA_EMULATION=ON)

pip() { "$env/bin/python" -m pip --disable-pip-version-check "$@"; }
# guidedFilter, not ximgproc itself: an emptied package leaves an importable shell behind.
contrib_works() { "$env/bin/python" -c 'import sys, cv2; sys.exit(not hasattr(getattr(cv2, "ximgproc", None), "guidedFilter"))' 2>/dev/null; }

if [ "$packages_now" != "$packages_before" ]; then
  pins=(-c constraints.txt)
  if "$env/bin/python" -c 'import sys; sys.exit(sys.version_info[:2] >= (3, 11))'; then
    echo "beags setup: constraints.txt needs Python 3.11 or newer; installing unpinned versions"
    pins=()
  fi
  rm -f "$env/.beags-packages" "$env/.beags-source"
  # pybind11 is for fpsample, which comes to some machines as source only.
  pip install -qq "${pins[@]}" scikit-build-core nanobind ninja pybind11 'setuptools>=77,<81'
  if ! command -v cmake >/dev/null; then pip install -qq cmake; fi
  # Without a CUDA toolkit, nvcc of the version that torch was built with.
  if [ "$(uname -s)" = Linux ] && [ ${#pins[@]} -gt 0 ] && ! command -v nvcc >/dev/null && [ ! -x /usr/local/cuda/bin/nvcc ]; then
    pip install -qq "${pins[@]}" 'cuda-toolkit[nvcc]' nvidia-cuda-cccl ||
      echo "beags setup: pip cannot install nvcc here; going on without kernels for GPUs"
  fi
  # sam2 (transformers) is for the tests of its masks; it brings no weights.
  # The build tools are in the environment by now, so the build needs no isolated copy of them.
  pip install -qq --no-build-isolation "${build[@]}" "${pins[@]}" -e '.[dev,sam2]'
  # nerfstudio brings plain opencv, which shares the folder cv2/ with contrib: the one written last wins.
  if ! contrib_works; then
    pip install -qq "${pins[@]}" --force-reinstall --no-deps "$opencv"
    contrib_works || fail "cv2.ximgproc.guidedFilter is missing after installing $opencv: delete $env and run make setup again."
  fi
  echo "$packages_now" >"$env/.beags-packages"
  echo "$source_now" >"$env/.beags-source"
elif [ "$source_now" != "$source_before" ]; then
  rm -f "$env/.beags-source"
  pip install -qq --no-deps --no-build-isolation "${build[@]}" -e .
  echo "$source_now" >"$env/.beags-source"
fi
if [ "$joined_now" != "$joined_before" ]; then
  rm -f "$env/.beags-joined"
  for folder in "${joined[@]}"; do
    pip install -qq --no-deps --no-build-isolation -e "./$folder"
  done
  echo "$joined_now" >"$env/.beags-joined"
fi
