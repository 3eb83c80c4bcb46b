#!/usr/bin/env bash
# Masks of the LEGO digger in Mip-NeRF 360's "kitchen" (25 views of 779 x 519) from boxes in four views, by GrabCut:
# docs/pictures/kitchen_digger.sh <folder of the scene> [output]
# Trains a base without masks, makes masks with its depth, lets all views vote on them, and writes pictures to look at:
# made.png (all masks), check/contradicted.png, reprojected/before_after.png. About five minutes of one core.
set -euo pipefail
here="$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)"
scene="${1:?usage: docs/pictures/kitchen_digger.sh <folder of the scene> [output]}"
output="${2:-outputs/kitchen_digger}"

if [ ! -f "$output/base/training.json" ]; then
  ns-train beags-fast --pipeline.model.refine-steps 0 --data "$scene" --run-dir "$output/base" --vis tensorboard \
    beags-data --downscale-factor 2
fi
beags masks make --data "$scene" --source grabcut --options "prompts=$here/kitchen_digger.json" held_out=true \
  --load-config "$output/base/config.yml" --output "$output" --overwrite
beags masks check --data "$scene" --masks-path "$output/masks" --classes-path "$output/classes.json" \
  --load-config "$output/base/config.yml" --output "$output/check"
beags masks reproject --load-config "$output/base/config.yml" --masks-path "$output/masks" \
  --classes-path "$output/classes.json" --run-size --output "$output/reprojected"
