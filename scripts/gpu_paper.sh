#!/usr/bin/env bash
# The paper's method at its own length on real photos, where a GPU is at hand:
#   scripts/gpu_paper.sh --data-root SCENES --truth TRUTH [--out FOLDER] [--size PIXELS] [CAPTURE ...]
# From one base of beags-paper (30,000 steps) for each capture, 3,000 steps with the paper's losses, as many with neither,
# and the refinement of beags with its own control; photos of at most PIXELS (806) along the longer side. Captures: fruit
# and garden if none is named; they train at the same time on one GPU. It needs an NVIDIA GPU, and a Python (PYTHON,
# default python3) with this package, its CUDA extension, nerfstudio, and benchmarks/. A second call goes on where the first ended, so
# a call ends after SECONDS_LIMIT (600). Logs and <capture>.json go to FOLDER (default outputs/gpu_paper).
set -uo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
python="${PYTHON:-python3}"
out=outputs/gpu_paper size=806 data='' truth='' captures=()

fail() {
  echo "gpu_paper: $1" >&2
  exit 1
}
while [ $# -gt 0 ]; do
  case "$1" in
    --out | --size | --data-root | --truth)
      [ $# -ge 2 ] || fail "$1 wants a value"
      case "$1" in --out) out="$2" ;; --size) size="$2" ;; --data-root) data="$2" ;; --truth) truth="$2" ;; esac
      shift 2
      ;;
    -*) fail "there is no option $1: the file's first lines say what it takes" ;;
    *)
      captures+=("$1")
      shift
      ;;
  esac
done
if [ ${#captures[@]} = 0 ]; then captures=(fruit garden); fi
[ -d "$data" ] || fail "--data-root '$data' is no folder: name the one that holds ${captures[*]}"
[ -d "$truth" ] || fail "--truth '$truth' is no folder: name the one that holds traced silhouettes"
command -v nvidia-smi >/dev/null && nvidia-smi -L || fail "there is no NVIDIA GPU, or no driver for it"
"$python" -c 'import nerfstudio' 2>/dev/null || fail "$python has no nerfstudio: install this package there (docs/install.md)"
"$python" -c 'import beags_benchmarks' 2>/dev/null || fail "$python has no beags bench: call $python -m pip install ./benchmarks"
reason="$("$python" -c 'from beags_plugin.rasterizers.cuda import CudaRasterizer as R; print(R.unavailable() or "")' 2>&1 | tail -n 1)"
[ -z "$reason" ] || fail "$reason"
mkdir -p "$out"

train() { # one capture, with the best masks at hand
  timeout --kill-after 20 "${SECONDS_LIMIT}" "$python" -c 'from beags_plugin.commands.cli import main; raise SystemExit(main())' \
    bench captures --data-root "$data" --truth "$truth" --size "$size" --preset beags-paper --scenes "$1" \
    --masks given picked --output "$out/$1" --json "$out/$1.json" --variants "as long as the paper, neither loss" \
    "the paper's losses" "as long as beags-refine, neither loss" beags-refine >"$out/$1.log" 2>&1
}

SECONDS_LIMIT="${SECONDS_LIMIT:-600}"
declare -A jobs
for capture in "${captures[@]}"; do
  train "$capture" &
  jobs[$capture]=$!
done
failed=()
for capture in "${captures[@]}"; do
  wait "${jobs[$capture]}"
  code=$?
  if [ "$code" = 124 ] || [ "$code" = 137 ]; then
    failed+=("$capture (out of time: call again to go on)")
  elif [ "$code" != 0 ]; then
    failed+=("$capture")
  fi
  echo "== $capture"
  tail -n 40 "$out/$capture.log"
done
if [ ${#failed[@]} -gt 0 ]; then fail "not done: ${failed[*]}; the logs are in $out"; fi
echo "gpu_paper: done; the figures are in $out"
