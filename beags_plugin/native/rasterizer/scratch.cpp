#include "rasterizer/scratch.h"

#include <algorithm>
#include <cstdint>
#include <mutex>
#include <new>
#include <vector>

namespace beags {
namespace {

constexpr size_t kMostKept = 128 << 20;
constexpr size_t kLeast = 4096;  // least bytes of a block: small requests share blocks, so that few are searched
constexpr std::align_val_t kAlignment{64};

struct Block {
  void* memory;
  size_t bytes;
};

struct Kept {
  std::mutex mutex;
  std::vector<Block> blocks;  // oldest first
  size_t bytes = 0;

  Block remove(size_t i) {
    const Block block = blocks[i];
    blocks.erase(blocks.begin() + static_cast<std::ptrdiff_t>(i));
    bytes -= block.bytes;
    return block;
  }
};

Kept& kept() {
  static Kept* const all = new Kept;  // It is never destroyed, because frames may outlive all other objects.
  return *all;
}

}  // namespace

void* take_scratch(size_t& bytes) {
  bytes = std::max(bytes, kLeast);
  {
    const std::lock_guard<std::mutex> lock(kept().mutex);
    size_t best = SIZE_MAX;
    for (size_t i = 0; i < kept().blocks.size(); ++i) {
      const size_t size = kept().blocks[i].bytes;
      const bool fits = size >= bytes && size / 2 <= bytes;
      if (fits && (best == SIZE_MAX || size < kept().blocks[best].bytes)) best = i;
    }
    if (best != SIZE_MAX) {
      const Block block = kept().remove(best);
      bytes = block.bytes;
      return block.memory;
    }
  }
  bytes += bytes / 8 + 64;  // A slightly larger next render then still fits.
  return ::operator new(bytes, kAlignment);
}

void give_scratch(void* block, size_t bytes) {
  const std::lock_guard<std::mutex> lock(kept().mutex);
  kept().blocks.push_back({block, bytes});
  kept().bytes += bytes;
  while (kept().bytes > kMostKept) ::operator delete(kept().remove(0).memory, kAlignment);
}

}  // namespace beags
