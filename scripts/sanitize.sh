#!/usr/bin/env bash
# The extension's tests on builds with GCC's sanitizers: scripts/sanitize.sh [address] [thread]
# address finds bad memory accesses and undefined behaviour, in the emulation of the CUDA kernels too; thread finds data
# races between the CPU's threads. Needs the environment of `make setup` (BEAGS_VENV, default .venv) and GCC 10 or
# later. Works on a copy under build/sanitize; the exit code tells whether a test failed or a sanitizer spoke up.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
root="$PWD"
case "${BEAGS_VENV:=.venv}" in /*) ;; *) BEAGS_VENV="$root/$BEAGS_VENV" ;; esac
export PATH="$BEAGS_VENV/bin:$PATH" PYTHONDONTWRITEBYTECODE=1
tests=(tests/test_{native,native_arguments,native_isa,native_work,rasterizer_reference,rasterizer_robustness,invariances,fuzz}.py
  tests/test_{image_ops,occupancy_loss,ops_everywhere,reprojection_votes,sh_colors,slabs,sparse_sums,voxel_grid,voxel_lookup,class_maps}.py)
tsan_options="suppressions=$root/tests/native/tsan.supp exitcode=66"
emulated=(tests/test_cuda_{rasterizer,ops,votes}.py)

run() { # kind, options of CMake, tests...
  local kind="$1" emulation="$2" folder="$root/build/sanitize/$1"
  shift 2
  mkdir -p "$folder/tree"
  git ls-files -z --cached --others --exclude-standard | xargs -0 cp --parents -t "$folder/tree"
  cmake -S . -B "$folder/cmake" -G Ninja -DCMAKE_BUILD_TYPE=None -DBEAGS_SANITIZE="$kind" -DBEAGS_CUDA=OFF \
    -DBEAGS_CUDA_EMULATION="$emulation" -DPython_EXECUTABLE="$(command -v python)" \
    -Dnanobind_DIR="$(python -m nanobind --cmake_dir)" >"$folder/cmake.log"
  cmake --build "$folder/cmake"
  cp "$folder"/cmake/_*.so "$folder/tree/beags_plugin/"
  # The sanitizer's runtime comes first; libstdc++ with it, whose exceptions it wraps.
  local runtime
  case "$kind" in address) runtime=libasan.so ;; thread) runtime=libtsan.so ;; esac
  runtime="$(cc -print-file-name="$runtime")"
  [ -e "$runtime" ] || {
    echo "sanitize: $(cc --version | head -1) has no runtime of the $kind sanitizer: install it" >&2
    exit 1
  }
  (cd "$folder/tree" && BEAGS_REQUIRE_NATIVE=1 LD_PRELOAD="$runtime $(c++ -print-file-name=libstdc++.so.6)" \
    ASAN_OPTIONS=detect_leaks=0 UBSAN_OPTIONS=print_stacktrace=1 \
    TSAN_OPTIONS="$tsan_options" \
    python -m pytest -q -p no:cacheprovider "$@")
}

race_is_seen() { # that the thread sanitizer finds one in a parallel loop, or its silence would mean nothing
  local folder="$root/build/sanitize/thread" status=0
  mkdir -p "$folder"
  c++ -g -fopenmp -fsanitize=thread tests/native/race.cpp tests/native/openmp_on_threads.cpp -o "$folder/race"
  TSAN_OPTIONS="$tsan_options" "$folder/race" >"$folder/race.log" 2>&1 || status=$?
  [ "$status" = 66 ] || {
    echo "sanitize: the thread sanitizer does not see a race in a parallel loop ($folder/race.log)" >&2
    exit 1
  }
}

for kind in "${@:-address thread}"; do
  for one in $kind; do
    case "$one" in
    address) run address ON "${tests[@]}" "${emulated[@]}" ;;
    thread)
      race_is_seen
      OMP_NUM_THREADS=4 run thread OFF "${tests[@]}" -k "not torch and not cuda"
      ;;
    *)
      echo "sanitize: there is no sanitizer $one: address or thread" >&2
      exit 2
      ;;
    esac
  done
done
