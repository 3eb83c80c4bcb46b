#!/usr/bin/env bash
# The extension's tests on builds with GCC's sanitizers: scripts/sanitize.sh [address] [thread] [kernels]
# address finds bad memory accesses and undefined behaviour, in the emulation of the CUDA kernels too; thread finds data
# races between the CPU's threads, kernels those between the threads of the emulated CUDA kernels. Needs the
# environment of `make setup` (BEAGS_VENV, default .venv) and GCC 10 or later. Works on a copy under build/sanitize; the
# exit code tells whether a test failed or a sanitizer spoke up.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
root="$PWD"
case "${BEAGS_VENV:=.venv}" in /*) ;; *) BEAGS_VENV="$root/$BEAGS_VENV" ;; esac
export PATH="$BEAGS_VENV/bin:$PATH" PYTHONDONTWRITEBYTECODE=1
tests=(tests/rasterizers/test_{compiled,native,native_arguments,native_isa,native_work,rasterizer_reference,rasterizer_robustness,invariances}.py
  tests/ops/test_{image_ops,occupancy_loss,ops_everywhere,reprojection_votes,sh_colors,sparse_sums,voxel_lookup}.py
  tests/masks/test_spatial_chunks.py tests/occupancy tests/labels/test_classes.py tests/soak/test_fuzz.py)
tsan_options="suppressions=$root/tests/native/tsan.supp exitcode=66"
emulated=(tests/rasterizers/test_{compiled,cuda_rasterizer}.py tests/ops/test_cuda_{ops,votes}.py)
kernels=("${emulated[@]}" tests/ops/test_image_ops.py)

run() { # kind, sanitizer, whether with the emulation, tests...
  local kind="$1" sanitizer="$2" emulation="$3" folder="$root/build/sanitize/$1"
  shift 3
  mkdir -p "$folder/tree"
  git ls-files -z --cached --others --exclude-standard | xargs -0 cp --parents -t "$folder/tree"
  cmake -S . -B "$folder/cmake" -G Ninja -DCMAKE_BUILD_TYPE=RelWithDebInfo -DBEAGS_SANITIZE="$sanitizer" -DBEAGS_CUDA=OFF \
    -DBEAGS_CUDA_EMULATION="$emulation" -DPython_EXECUTABLE="$(command -v python)" \
    -Dnanobind_DIR="$(python -m nanobind --cmake_dir)" >"$folder/cmake.log"
  cmake --build "$folder/cmake"
  cp "$folder"/cmake/_*.so "$folder/tree/beags_plugin/"
  # The sanitizer's runtime comes first; libstdc++ with it, whose exceptions it wraps; and the emulation, whose names the
  # sanitizer does not find if it is loaded later.
  local runtime
  case "$sanitizer" in address) runtime=libasan.so ;; thread) runtime=libtsan.so ;; esac
  runtime="$(cc -print-file-name="$runtime")"
  [ -e "$runtime" ] || {
    echo "sanitize: $(cc --version | head -1) has no runtime of the $sanitizer sanitizer: install it" >&2
    exit 1
  }
  local preloaded="$runtime $(c++ -print-file-name=libstdc++.so.6)"
  if [ "$kind" = kernels ]; then preloaded+=" $(echo "$folder"/tree/beags_plugin/_cuda_emulation*.so)"; fi
  (cd "$folder/tree" && BEAGS_REQUIRE_NATIVE=1 LD_PRELOAD="$preloaded" \
    ASAN_OPTIONS=detect_leaks=0 UBSAN_OPTIONS=print_stacktrace=1 \
    TSAN_OPTIONS="$tsan_options" \
    python -m pytest -q --capture=sys -p no:cacheprovider "$@")
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

races_in_kernels_are_seen() { # and only those that are there
  local folder="$root/build/sanitize/kernels" what wanted unordered status
  mkdir -p "$folder"
  c++ -std=c++17 -O1 -g -DBEAGS_CUDA_EMULATION -Ibeags_plugin/native -fsanitize=thread tests/native/race_in_kernel.cpp \
    -o "$folder/race"
  for what in "barrier 0" "none 66" "atomic 0 1" "blocks 66 1"; do
    read -r what wanted unordered <<<"$what"
    status=0
    TSAN_OPTIONS="$tsan_options" ${unordered:+env BEAGS_EMULATION_UNORDERED=1} "$folder/race" "$what" >"$folder/race.log" 2>&1 || status=$?
    [ "$status" = "$wanted" ] || {
      echo "sanitize: of the kernel \"$what\" the thread sanitizer says $status, not $wanted ($folder/race.log)" >&2
      exit 1
    }
  done
}

for kind in "${@:-address thread kernels}"; do
  for one in $kind; do
    case "$one" in
    address) run address address ON "${tests[@]}" "${emulated[@]}" ;;
    thread)
      race_is_seen
      OMP_NUM_THREADS=4 run thread thread OFF "${tests[@]}" -k "not torch and not cuda"
      ;;
    kernels)
      races_in_kernels_are_seen
      OMP_NUM_THREADS=1 run kernels thread ON "${kernels[@]}"
      # Blocks unordered; shared memory, which is one place for all of them here, is passed over.
      tsan_options="${tsan_options/tsan.supp/tsan_shared.supp}"
      BEAGS_EMULATION_UNORDERED=1 OMP_NUM_THREADS=1 run kernels thread ON "${kernels[@]}"
      ;;
    *)
      echo "sanitize: there is no sanitizer $one: address, thread or kernels" >&2
      exit 2
      ;;
    esac
  done
done
