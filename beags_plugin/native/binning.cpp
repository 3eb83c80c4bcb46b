#include "binning.h"

#include <algorithm>
#include <cstring>

#include "extent.h"

namespace beags {
namespace {

constexpr int64_t kChunk = 512;  // surfels that one thread bins at a time

template <class T>
struct BitsOf;
template <>
struct BitsOf<float> {
  using type = uint32_t;
};
template <>
struct BitsOf<double> {
  using type = uint64_t;
};

// Stable radix sort by depth. Depths are positive, so their bits rise as they do.
template <class T>
void sort_by_depth(const Splat<T>* splats, std::vector<int32_t>& indices) {
  using Bits = typename BitsOf<T>::type;
  struct Item {
    Bits key;
    int32_t index;
  };
  constexpr int kDigit = 11;
  constexpr int kPasses = (8 * sizeof(Bits) + kDigit - 1) / kDigit;
  const size_t n = indices.size();
  std::vector<Item> items(n), other(n);
  std::vector<uint32_t> counts(static_cast<size_t>(kPasses) << kDigit);
  for (size_t i = 0; i < n; ++i) {
    std::memcpy(&items[i].key, &splats[indices[i]].z, sizeof(Bits));
    items[i].index = indices[i];
    for (int pass = 0; pass < kPasses; ++pass) {
      ++counts[(pass << kDigit) + ((items[i].key >> (pass * kDigit)) & ((1u << kDigit) - 1))];
    }
  }
  for (int pass = 0; pass < kPasses; ++pass) {
    uint32_t* count = counts.data() + (pass << kDigit);
    uint32_t sum = 0;
    for (int digit = 0; digit < 1 << kDigit; ++digit) {
      const uint32_t here = count[digit];
      count[digit] = sum;
      sum += here;
    }
    for (const Item& item : items) other[count[(item.key >> (pass * kDigit)) & ((1u << kDigit) - 1)]++] = item;
    items.swap(other);
  }
  for (size_t i = 0; i < n; ++i) indices[i] = items[i].index;
}

struct Reach {
  int32_t tile, splat;
  uint16_t mask;
};

// Adds the tiles that the surfel reaches; returns whether it is on the screen.
template <class T>
bool reach(const View& view, const Splat<T>& splat, int32_t index, std::vector<Reach>& out) {
  const Extent extent(view, splat);
  const int tiles_x = tiles_along(view.width);
  if (extent.first_row() > extent.last_row()) return extent.on_screen();
  for (int tile_y = extent.first_row() / kTile; tile_y <= extent.last_row() / kTile; ++tile_y) {
    const Bands bands = extent.bands(tile_y);
    int first = tiles_x * kGroup, last = -1;
    for (int row = 0; row < kGroup; ++row) {
      if (bands.first[row] > bands.last[row]) continue;
      first = std::min(first, bands.first[row]);
      last = std::max(last, bands.last[row]);
    }
    for (int tile_x = first / kGroup; tile_x * kGroup <= last; ++tile_x) {
      unsigned mask = 0;
      for (int row = 0; row < kGroup; ++row) {
        const int from = std::max(bands.first[row] - tile_x * kGroup, 0);
        const int to = std::min(bands.last[row] - tile_x * kGroup, kGroup - 1);
        const unsigned bits = from > to ? 0 : (2u << to) - (1u << from);
        mask |= bits << (kGroup * row);
      }
      if (mask) out.push_back({tile_y * tiles_x + tile_x, index, static_cast<uint16_t>(mask)});
    }
  }
  return extent.on_screen();
}

}  // namespace

template <class T>
Bins bin(const View& view, const Splat<T>* splats, std::vector<int32_t> drawn, bool* visible, int threads) {
  Bins bins;
  sort_by_depth(splats, drawn);
  bins.order = std::move(drawn);
  const int64_t n = static_cast<int64_t>(bins.order.size()), chunks = (n + kChunk - 1) / kChunk;
  std::vector<std::vector<Reach>> reached(chunks);
  bins.record_start.assign(n + 1, 0);
#pragma omp parallel for num_threads(threads) schedule(dynamic, 1)
  for (int64_t chunk = 0; chunk < chunks; ++chunk) {
    for (int64_t rank = chunk * kChunk; rank < std::min(n, (chunk + 1) * kChunk); ++rank) {
      const size_t before = reached[chunk].size();
      const int32_t index = bins.order[rank];
      visible[index] = reach(view, splats[index], index, reached[chunk]);
      bins.record_start[rank + 1] = static_cast<int64_t>(reached[chunk].size() - before);
    }
  }
  for (int64_t rank = 0; rank < n; ++rank) bins.record_start[rank + 1] += bins.record_start[rank];

  bins.tile_start.assign(static_cast<size_t>(tiles_along(view.width)) * tiles_along(view.height) + 1, 0);
  for (const auto& chunk : reached) {
    for (const Reach& at : chunk) ++bins.tile_start[at.tile + 1];
  }
  for (size_t tile = 1; tile < bins.tile_start.size(); ++tile) bins.tile_start[tile] += bins.tile_start[tile - 1];
  bins.pairs.resize(bins.tile_start.back() + kPrefetched);
  std::vector<int64_t> next(bins.tile_start.begin(), bins.tile_start.end() - 1);
  int32_t record = 0;
  for (const auto& chunk : reached) {
    for (const Reach& at : chunk) bins.pairs[next[at.tile]++] = {at.splat, record++, at.mask};
  }
  return bins;
}

template Bins bin(const View&, const Splat<float>*, std::vector<int32_t>, bool*, int);
template Bins bin(const View&, const Splat<double>*, std::vector<int32_t>, bool*, int);

}  // namespace beags
