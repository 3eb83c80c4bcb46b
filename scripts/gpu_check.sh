#!/usr/bin/env bash
# Everything that needs a GPU:
#   scripts/gpu_check.sh [--out FOLDER] [build] [tests] [memcheck] [racecheck] [synccheck] [benchmark]
# Without names of stages it runs them all; where a command may only run for a few minutes, name one stage a call
# (and build in each call, if the machine is a fresh one every time). It needs an NVIDIA GPU, nvcc, CMake, a C++
# compiler, and a Python (PYTHON, default python3) with torch for CUDA, nanobind, numpy, scipy, rich,
# pytest and hypothesis; no nerfstudio. Where gsplat is installed, its kernels may take GSPLAT_SECONDS (150) to
# compile, else it is left out. The benchmark begins nothing new after BENCHMARK_SECONDS (500). It builds in place,
# for the GPU that is here, and changes nothing outside the repository. A stage that fails does not stop the
# others, except that nothing runs after a build that failed; the exit code tells. Logs and cuda.json go to FOLDER
# (default build/gpu_check).
set -uo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
python="${PYTHON:-python3}"
out=build/gpu_check
if [ "${1:-}" = --out ]; then
  out="$2"
  shift 2
fi
stages=("$@")
if [ ${#stages[@]} = 0 ]; then stages=(build tests memcheck racecheck synccheck benchmark); fi
mkdir -p "$out"
export OMP_WAIT_POLICY=PASSIVE PYTHONPATH="$PWD:$PWD/benchmarks${PYTHONPATH:+:$PYTHONPATH}" PYTHONUNBUFFERED=1

fail() {
  echo "gpu_check: $1" >&2
  exit 1
}
for stage in "${stages[@]}"; do
  case "$stage" in build | tests | memcheck | racecheck | synccheck | benchmark) ;; *) fail "there is no stage $stage" ;; esac
done
command -v nvidia-smi >/dev/null && nvidia-smi -L || fail "there is no NVIDIA GPU, or no driver for it"
packages="$("$python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))' 2>/dev/null)"
for folder in /usr/local/cuda/bin "$packages"/nvidia/cu*/bin; do export PATH="$PATH:$folder"; done
command -v nvcc >/dev/null || fail "there is no nvcc: install the CUDA toolkit, or pip install 'cuda-toolkit[nvcc]' nvidia-cuda-cccl"
for tool in cmake c++; do command -v "$tool" >/dev/null || fail "there is no $tool: install it"; done
for package in torch nanobind numpy scipy rich pytest hypothesis; do
  "$python" -c "import $package" 2>/dev/null || fail "$python has no $package: install it with pip"
done
"$python" -c 'import torch, sys; sys.exit(not torch.cuda.is_available())' || fail "$python has no torch that sees the GPU"

build() {
  local architecture
  architecture="$("$python" -c 'import torch; print("%d%d" % torch.cuda.get_device_capability(0))')"
  cmake -S . -B build/gpu -DCMAKE_BUILD_TYPE=Release -DPython_EXECUTABLE="$(command -v "$python")" \
    -Dnanobind_DIR="$("$python" -m nanobind --cmake_dir)" -DBEAGS_CUDA=ON \
    -DBEAGS_CUDA_ARCHITECTURES="$architecture" -DBEAGS_CUDA_EMULATION=ON &&
    cmake --build build/gpu -j "$(nproc)" && cp build/gpu/_*.so beags_plugin/ &&
    "$python" -c 'from beags_plugin.rasterizers.cuda import CudaRasterizer as R; import sys; sys.exit(R.unavailable())'
}

tests() { # everything that draws or uses an op on the GPU; nothing here imports nerfstudio
  "$python" -m pytest -q -p no:cacheprovider tests/ops/test_{cuda_ops,cuda_votes,image_ops}.py \
    tests/rasterizers/test_{cuda_rasterizer,cuda_gpu,rasterizer_reference,rasterizer_robustness}.py \
    tests/rasterizers/test_{screen_shift,extremes,invariances,sparse_class_ids}.py tests/picking/test_cut.py \
    -k "cuda and not emulated"
}

sanitized() { # a tool of compute-sanitizer on a small scene, three minutes at most
  command -v compute-sanitizer >/dev/null || {
    echo "compute-sanitizer is not there"
    return 77
  }
  PYTORCH_NO_CUDA_MEMORY_CACHING=1 timeout --kill-after 10 170 compute-sanitizer --tool "$1" --error-exitcode 9 \
    "$python" -m beags_benchmarks.kernels.cuda --smoke
}
memcheck() { sanitized memcheck; }
racecheck() { sanitized racecheck; }
synccheck() { sanitized synccheck; }

benchmark() {
  "$python" -m beags_benchmarks.kernels.cuda --json "$out/cuda.json" --seconds "${BENCHMARK_SECONDS:-500}" \
    --gsplat-seconds "${GSPLAT_SECONDS:-150}"
}

failed=() skipped=()
for stage in "${stages[@]}"; do
  echo "== $stage"
  SECONDS=0
  if [ "$stage" != build ] && ! ls beags_plugin/_native*.so >/dev/null 2>&1; then
    fail "there is no beags_plugin/_native*.so here: name the stage build first"
  fi
  "$stage" >"$out/$stage.log" 2>&1
  code=$?
  word=ok
  if [ "$code" = 77 ]; then
    word=skipped
    skipped+=("$stage")
  elif [ "$code" != 0 ]; then
    word=FAILED
    if [ "$code" = 124 ] || [ "$code" = 137 ]; then word="FAILED (stopped: out of time)"; fi
    failed+=("$stage")
  fi
  tail -n 25 "$out/$stage.log"
  echo "== $stage: $word, $SECONDS s"
  if [ "$stage" = build ] && [ "$code" != 0 ]; then
    echo "gpu_check: without a build nothing else can run; the compiler's words are in $out/build.log" >&2
    break
  fi
done
if [ ${#failed[@]} -gt 0 ]; then fail "failed: ${failed[*]}"; fi
echo "gpu_check: all is well${skipped[*]:+, but for what was skipped: ${skipped[*]}}"
