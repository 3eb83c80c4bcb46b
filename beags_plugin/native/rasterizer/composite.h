// Evaluates one Gaussian at a few pixels, and walks through a tile front to back (E2, E3). Included once for each
// instruction set.
#pragma once

#include "rasterizer/packs.h"
#include "rasterizer/pixel_terms.h"
#include "rasterizer/types.h"

namespace beags {
namespace BEAGS_ISA {

template <class T>
constexpr int kPacks = kGroupPixels / kLanes<T>;  // packs of pixels, one lane each, in a group of 4 x 4
template <class T>
constexpr int kTilePacks = kGroupPixels * kPacks<T>;

// A compile-time number.
template <int kValue>
struct Number {
  BEAGS_INLINE constexpr operator int() const { return kValue; }
};

// Calls visit(index into the image, pixel of the tile, columns) for the first pixel of every row of every group of the
// tile inside the image, in a fixed order; most rows have all of a group's columns.
template <class T, class Visit>
BEAGS_INLINE void for_each_row(const Job<T>& job, int tile, Visit visit) {
  const int x0 = tile % job.tiles_x * kTile, y0 = tile / job.tiles_x * kTile;
  for (int group = 0; group < kGroupPixels; ++group) {
    const int x = x0 + group % kGroup * kGroup, y = y0 + group / kGroup * kGroup;
    const int columns = job.width - x < kGroup ? job.width - x : kGroup;
    const int rows = job.height - y < kGroup ? job.height - y : kGroup;
    for (int row = 0; row < rows; ++row) {
      const int64_t at = static_cast<int64_t>(y + row) * job.width + x;
      const int pixel = kGroupPixels * group + kGroup * row;
      if (columns == kGroup) {
        visit(at, pixel, Number<kGroup>{});
      } else {
        visit(at, pixel, columns);
      }
    }
  }
}

// Calls visit(index into the image, pack, lane) for the pixels of a tile inside the image, in a fixed order.
template <class T, class Visit>
BEAGS_INLINE void for_each_pixel(const Job<T>& job, int tile, Visit visit) {
  for_each_row(job, tile, [&](int64_t at, int pixel, auto columns) __attribute__((always_inline)) {
    for (int i = 0; i < columns; ++i) visit(at + i, (pixel + i) / kLanes<T>, (pixel + i) % kLanes<T>);
  });
}

// Copies a tile from an image, [height, width, kChannels]. lanes(channel, pack) returns the place of a pack's values.
template <int kChannels, class T, class Lanes>
BEAGS_INLINE void read_image(const Job<T>& job, int tile, const T* image, Lanes lanes) {
  for_each_pixel(job, tile, [&](int64_t at, int pack, int lane) __attribute__((always_inline)) {
    for (int c = 0; c < kChannels; ++c) lanes(c, pack)[lane] = image[kChannels * at + c];
  });
}

// Copies a tile to an image; see read_image.
template <int kChannels, class T, class Lanes>
BEAGS_INLINE void write_image(const Job<T>& job, int tile, T* image, Lanes lanes) {
  for_each_pixel(job, tile, [&](int64_t at, int pack, int lane) __attribute__((always_inline)) {
    for (int c = 0; c < kChannels; ++c) image[kChannels * at + c] = lanes(c, pack)[lane];
  });
}

// Prefetches the tile's part of an image, [height, width, kChannels]; null: no image. Reads then wait once for all
// rows, not for each row.
template <int kChannels, class T>
BEAGS_INLINE void prefetch_image(const Job<T>& job, int tile, const T* image) {
  if (!image) return;
  const int x0 = tile % job.tiles_x * kTile, y0 = tile / job.tiles_x * kTile;
  const int columns = job.width - x0 < kTile ? job.width - x0 : kTile;
  const int rows = job.height - y0 < kTile ? job.height - y0 : kTile;
  const int bytes = columns * kChannels * static_cast<int>(sizeof(T));
  for (int row = 0; row < rows; ++row) {
    const T* first = image + (static_cast<int64_t>(y0 + row) * job.width + x0) * kChannels;
    const char* at = reinterpret_cast<const char*>(first);
    for (int byte = 0; byte < bytes; byte += 64) __builtin_prefetch(at + byte);
    __builtin_prefetch(at + bytes - 1);
  }
}

// Returns the place of a pack's values among the 256 of a tile.
template <class T>
BEAGS_INLINE int64_t saved_at(int tile, int pack) {
  return static_cast<int64_t>(tile) * kTilePixels + pack * kLanes<T>;
}

// The pixels' centres (the pixel plus 0.5), by pack.
template <class T>
struct Centres {
  alignas(64) T x[kTilePixels];
  T y[kTilePixels];

  Centres(const Job<T>& job, int tile) {
    const int x0 = tile % job.tiles_x * kTile, y0 = tile / job.tiles_x * kTile;
    for (int i = 0; i < kTilePixels; ++i) {
      const int group = i / kGroupPixels, pixel = i % kGroupPixels;
      x[i] = static_cast<T>(x0 + group % kGroup * kGroup + pixel % kGroup) + T(0.5);
      y[i] = static_cast<T>(y0 + group / kGroup * kGroup + pixel / kGroup) + T(0.5);
    }
  }

  // Registers of whole rows of a group are equal in x: the compiler then computes once what depends on x alone.
  BEAGS_INLINE Real<T> pack_x(int pack) const {
    Real<T> out = load(x + pack * kLanes<T>);
    if constexpr (kRegister<T> % kGroup == 0) {
      BEAGS_UNROLL for (int i = 1; i < kParts<T>; ++i) out.part[i] = out.part[0];
    }
    return out;
  }
  BEAGS_INLINE Real<T> pack_y(int pack) const { return load(y + pack * kLanes<T>); }
};

// The fields of a hit that later steps need besides alpha.
constexpr unsigned kNeedDepth = 1, kNeedNearness = 2, kNeedShape = 4;

// One Gaussian at the packs of a tile where it contributes. Other lanes hold 0.
template <class T>
struct Hits {
  int count;
  int pack[kTilePacks<T>];
  alignas(64) T alpha[kTilePixels];
  T depth[kTilePixels], nearness[kTilePixels];  // d and k / d of the hit
  T inverse[kTilePixels];                       // 1 / q2, and 0 where the low-pass wins over rho3d
  T rho[kTilePixels];

  BEAGS_INLINE Real<T> get(const T* field, int i) const { return load(field + i * kLanes<T>); }
};

// Adds the pack to `hits` if the Gaussian contributes to one of its `wanted` lanes.
template <bool kPlain, unsigned kNeeds, class T>
BEAGS_INLINE void evaluate(const Job<T>& job, const Splat<T>& s, int pack, Real<T> dx, Real<T> dy, Mask<T> wanted,
                           Hits<T>& hits) {
  const auto hit = gaussian_hit(s, job.near_plane, dx, dy, wanted, Number<kPlain>{});
  const int at = hits.count * kLanes<T>;
  store(hits.alpha + at, keep(hit.on, hit.alpha));
  if (kNeeds & kNeedDepth) store(hits.depth + at, keep(hit.on, hit.depth));
  if (kNeeds & kNeedNearness) store(hits.nearness + at, keep(hit.on, hit.nearness));
  if (kNeeds & kNeedShape) {
    store(hits.inverse + at, keep(hit.on, hit.inverse));
    store(hits.rho + at, keep(hit.on, hit.rho));
  }
  hits.pack[hits.count] = pack;
  hits.count += any(hit.on);
}

template <bool kValue>
struct Constant {
  static constexpr bool value = kValue;
};

BEAGS_INLINE int first_bit(unsigned bits) { return __builtin_ctz(bits); }

template <class T>
BEAGS_INLINE void prefetch(const Job<T>& job, const Pair& pair) {
  const char* splat = reinterpret_cast<const char*>(job.splats + pair.splat);
  for (unsigned line = 0; line < sizeof(Splat<T>); line += 64) __builtin_prefetch(splat + line);
  if (job.num_features) __builtin_prefetch(job.features + static_cast<int64_t>(pair.splat) * job.num_features);
}

// The state of a tile that is composited front to back.
template <class T>
struct Walk {
  Centres<T> centre;
  alignas(64) T transmittance[kTilePixels];
  T end[kTilePixels];  // pairs before the one at which the pixel stopped
  Mask<T> live[kTilePacks<T>];
  unsigned active = 0;    // groups with a live pixel
  int64_t evaluated = 0;  // packs evaluated so far

  Walk(const Job<T>& job, int tile) : centre(job, tile) {
    const int pairs = static_cast<int>(job.tile_start[tile + 1] - job.tile_start[tile]);
    T inside[kTilePixels] = {};
    for_each_pixel(job, tile, [&](int64_t, int pack, int lane) {
      inside[pack * kLanes<T> + lane] = T(1);
      active |= 1u << (pack / kPacks<T>);
    });
    for (int i = 0; i < kTilePixels; ++i) {
      transmittance[i] = T(1);
      end[i] = inside[i] * static_cast<T>(pairs);
    }
    for (int pack = 0; pack < kTilePacks<T>; ++pack) live[pack] = all(T(0.5)) < load(inside + pack * kLanes<T>);
  }

  // Saves where each pixel stopped, for the backward.
  void save(const Saved<T>& to, int tile) const {
    for (int pack = 0; pack < kTilePacks<T>; ++pack) {
      const int64_t at = saved_at<T>(tile, pack);
      store(to.end_transmittance + at, load(transmittance + pack * kLanes<T>));
      store(to.end + at, load(end + pack * kLanes<T>));
    }
  }

  void stop(int pack, Mask<T> stopped, int k) {
    T* at = end + pack * kLanes<T>;
    store(at, select(stopped, all(static_cast<T>(k)), load(at)));
    live[pack] = without(live[pack], stopped);
    const int group = pack / kPacks<T>;
    for (int i = 0; i < kPacks<T>; ++i) {
      if (any(live[group * kPacks<T> + i])) return;
    }
    active &= ~(1u << group);
  }
};

// Evaluates a Gaussian at the groups of pixels in `groups`; wanted(pack) are the lanes that count. Doing this
// before the hits are used keeps the chains of dependent operations short.
template <unsigned kNeeds, class T, class Wanted>
BEAGS_INLINE void collect(const Job<T>& job, const Splat<T>& splat, unsigned groups, const Centres<T>& centre,
                          Hits<T>& hits, Wanted wanted) {
  const auto each = [&](auto plain) __attribute__((always_inline)) {
    for (; groups; groups &= groups - 1) {
      const int first = first_bit(groups) * kPacks<T>;
      for (int pack = first; pack < first + kPacks<T>; ++pack) {
        const Real<T> dx = centre.pack_x(pack) - all(splat.cx), dy = centre.pack_y(pack) - all(splat.cy);
        evaluate<decltype(plain)::value, kNeeds>(job, splat, pack, dx, dy, wanted(pack), hits);
      }
    }
  };
  hits.count = 0;
  if (splat.plain) {
    each(Constant<true>{});
  } else {
    each(Constant<false>{});
  }
}

// Composites a tile front to back: calls visit(k, splat, hits, i, w, before) for each Gaussian and each i of its hits.
// k counts pairs within the tile, w is 0 in lanes where nothing is added, `before` is T.
template <unsigned kNeeds, class T, class Visit>
BEAGS_INLINE void composite(const Job<T>& job, int tile, Walk<T>& walk, Visit visit) {
  const Pair* pairs = job.pairs + job.tile_start[tile];
  const int count = static_cast<int>(job.tile_start[tile + 1] - job.tile_start[tile]);
  Hits<T> hits;
  for (int k = 0; k < count && walk.active; ++k) {
    prefetch(job, pairs[k + kPrefetched]);
    const Splat<T>& splat = job.splats[pairs[k].splat];
    const unsigned groups = pairs[k].mask & walk.active;
    walk.evaluated += __builtin_popcount(groups) * kPacks<T>;
    collect<kNeeds>(job, splat, groups, walk.centre, hits,
                    [&](int pack) __attribute__((always_inline)) { return walk.live[pack]; });
    for (int i = 0; i < hits.count; ++i) {
      const int pack = hits.pack[i];
      T* transmittance = walk.transmittance + pack * kLanes<T>;
      const Real<T> before = load(transmittance);
      Real<T> w = hits.get(hits.alpha, i) * before, after = before - w;
      const Mask<T> stopped = after < all(T(kMinTransmittance));
      if (any(stopped)) {
        walk.stop(pack, stopped, k);
        w = drop(stopped, w);
        after = before - w;
      }
      store(transmittance, after);
      visit(k, splat, hits, i, w, before);
    }
  }
}

}  // namespace BEAGS_ISA
}  // namespace beags
