// Which surfels reach which tile, nearest first.
#pragma once

#include <vector>

#include "projection.h"
#include "types.h"

namespace beags {

struct Bins {
  std::vector<int32_t> order;         // the drawn surfels by rising depth, equal ones by index
  std::vector<int64_t> record_start;  // [order + 1]: the records of order[rank], in the order of their tiles
  std::vector<int64_t> tile_start;    // [tiles + 1] into pairs
  std::vector<Pair> pairs;            // by tile, then by rank; and kPrefetched unused ones
};

// drawn: indices of the surfels that were not culled, rising. visible: [N], set to true for those on the screen.
// Determinism: the surfels are split in chunks of a fixed size, so nothing depends on the number of threads.
template <class T>
Bins bin(const View& view, const Splat<T>* splats, std::vector<int32_t> drawn, bool* visible, int threads);

}  // namespace beags
