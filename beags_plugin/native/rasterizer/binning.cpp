#include "rasterizer/binning.h"

#include <algorithm>
#include <cstring>
#include <stdexcept>

#include "rasterizer/extent.h"

namespace beags {
namespace {

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

// Sorts stably by depth (radix sort). Depths are positive, so their bits have the same order.
template <class T>
void sort_by_depth(const T* depths, std::vector<int32_t>& indices) {
  using Bits = typename BitsOf<T>::type;
  struct Item {
    Bits key;
    int32_t index;
  };
  constexpr int kDigit = 11;
  constexpr int kPasses = (8 * sizeof(Bits) + kDigit - 1) / kDigit;
  const size_t n = indices.size();
  Scratch<Item> items(n), other(n);
  std::vector<uint32_t> counts(static_cast<size_t>(kPasses) << kDigit);
  for (size_t i = 0; i < n; ++i) {
    std::memcpy(&items[i].key, depths + indices[i], sizeof(Bits));
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
    for (size_t i = 0; i < n; ++i) {
      const Item item = items[i];
      other[count[(item.key >> (pass * kDigit)) & ((1u << kDigit) - 1)]++] = item;
    }
    std::swap(items, other);
  }
  for (size_t i = 0; i < n; ++i) indices[i] = items[i].index;
}

constexpr int kWordGroups = 64;  // groups of a row in one word, a bit each

// Returns the bits from .. to, 0 <= from <= to < 64.
uint64_t bits(int from, int to) { return (~uint64_t{0} >> (63 - to)) & (~uint64_t{0} << from); }

}  // namespace

template <class T>
bool find_tiles(const View& view, const Splat<T>& splat, std::vector<Reach>& out) {
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
    for (int origin = first / kGroup * kGroup; origin <= last; origin += kWordGroups) {
      uint64_t rows[kGroup];  // the reached groups of each row, from `origin` on
      for (int row = 0; row < kGroup; ++row) {
        const int from = std::max(bands.first[row] - origin, 0);
        const int to = std::min(bands.last[row] - origin, kWordGroups - 1);
        rows[row] = from > to ? 0 : bits(from, to);
      }
      const int end = std::min(last + 1, origin + kWordGroups);
      for (int group = origin; group < end; group += kGroup) {
        unsigned mask = 0;
        for (int row = 0; row < kGroup; ++row) {
          mask |= static_cast<unsigned>(rows[row] & 15) << (kGroup * row);
          rows[row] >>= kGroup;
        }
        if (mask) out.push_back({tile_y * tiles_x + group / kGroup, static_cast<uint16_t>(mask)});
      }
    }
  }
  return extent.on_screen();
}

template bool find_tiles(const View&, const Splat<float>&, std::vector<Reach>&);
template bool find_tiles(const View&, const Splat<double>&, std::vector<Reach>&);

template <class T>
Bins bin(const View& view, const std::vector<std::vector<Reach>>& reached, std::vector<int64_t> record_start,
         const T* depths) {
  Bins bins;
  bins.record_start = std::move(record_start);
  const int32_t n = static_cast<int32_t>(bins.record_start.size()) - 1;
  for (int32_t i = 0; i < n; ++i) {
    if (bins.record_start[i] < bins.record_start[i + 1]) bins.order.push_back(i);
  }
  sort_by_depth(depths, bins.order);

  bins.tile_start.assign(static_cast<size_t>(tiles_along(view.width)) * tiles_along(view.height) + 1, 0);
  for (const auto& chunk : reached) {
    for (const Reach& at : chunk) ++bins.tile_start[at.tile + 1];
  }
  for (size_t tile = 1; tile < bins.tile_start.size(); ++tile) {
    if (bins.tile_start[tile] > kMostTilePairs) throw std::runtime_error("over 16 million Gaussians reach one tile");
    bins.tile_start[tile] += bins.tile_start[tile - 1];
  }
  if (bins.tile_start.back() > INT32_MAX) throw std::runtime_error("over 2 billion pairs of a tile and a Gaussian");
  bins.pairs = Scratch<Pair>(bins.tile_start.back() + kPrefetched);
  std::fill_n(bins.pairs.get() + bins.tile_start.back(), kPrefetched, Pair{});
  const auto tiles_of = [&](int32_t gaussian) {
    const int64_t chunk = gaussian / kChunk;
    return reached[chunk].data() + (bins.record_start[gaussian] - bins.record_start[chunk * kChunk]);
  };
  std::vector<int64_t> next(bins.tile_start.begin(), bins.tile_start.end() - 1);
  const size_t ranks = bins.order.size();
  for (size_t rank = 0; rank < ranks; ++rank) {
    const int32_t gaussian = bins.order[rank];
    if (rank + 16 < ranks) __builtin_prefetch(bins.record_start.data() + bins.order[rank + 16]);
    if (rank + 8 < ranks) __builtin_prefetch(tiles_of(bins.order[rank + 8]));
    const Reach* tiles = tiles_of(gaussian);
    for (int64_t record = bins.record_start[gaussian]; record < bins.record_start[gaussian + 1]; ++record, ++tiles) {
      bins.pairs[next[tiles->tile]++] = {gaussian, static_cast<int32_t>(record), tiles->mask};
    }
  }
  return bins;
}

template Bins bin(const View&, const std::vector<std::vector<Reach>>&, std::vector<int64_t>, const float*);
template Bins bin(const View&, const std::vector<std::vector<Reach>>&, std::vector<int64_t>, const double*);

}  // namespace beags
