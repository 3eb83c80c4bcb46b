#include "cuda/rasterizer/primitives.h"

#if defined(BEAGS_CUDA_EMULATION)
#include <numeric>
#include <vector>
#else
#include <cub/device/device_radix_sort.cuh>
#include <cub/device/device_scan.cuh>
#endif

namespace beags {
namespace cuda {

#if defined(BEAGS_CUDA_EMULATION)

size_t temporary_bytes(int64_t) { return 1; }

void sort_pairs(void*, size_t, const uint32_t* keys, uint32_t* sorted_keys, const int32_t* values,
                int32_t* sorted_values, int64_t items, int first_bit, int end_bit, Stream) {
  const uint64_t mask = ((uint64_t(1) << (end_bit - first_bit)) - 1) << first_bit;
  std::vector<int64_t> order(items);
  std::iota(order.begin(), order.end(), int64_t(0));
  std::stable_sort(order.begin(), order.end(),
                   [&](int64_t a, int64_t b) { return (keys[a] & mask) < (keys[b] & mask); });
  for (int64_t i = 0; i < items; ++i) {
    sorted_keys[i] = keys[order[i]];
    sorted_values[i] = values[order[i]];
  }
}

void exclusive_sum(void*, size_t, int64_t* sums, int64_t items, Stream) {
  std::exclusive_scan(sums, sums + items, sums, int64_t(0));
}

#else

size_t temporary_bytes(int64_t items) {
  size_t sorting = 0, summing = 0;
  const uint32_t* keys = nullptr;
  const int32_t* values = nullptr;
  check(cub::DeviceRadixSort::SortPairs(nullptr, sorting, keys, static_cast<uint32_t*>(nullptr), values,
                                        static_cast<int32_t*>(nullptr), items, 0, 32),
        "sizing a sort");
  int64_t* sums = nullptr;
  check(cub::DeviceScan::ExclusiveSum(nullptr, summing, sums, sums, items), "sizing a prefix sum");
  return std::max(sorting, summing) + 1;
}

void sort_pairs(void* temporary, size_t bytes, const uint32_t* keys, uint32_t* sorted_keys, const int32_t* values,
                int32_t* sorted_values, int64_t items, int first_bit, int end_bit, Stream stream) {
  check(cub::DeviceRadixSort::SortPairs(temporary, bytes, keys, sorted_keys, values, sorted_values, items, first_bit,
                                        end_bit, stream),
        "sorting");
}

void exclusive_sum(void* temporary, size_t bytes, int64_t* sums, int64_t items, Stream stream) {
  check(cub::DeviceScan::ExclusiveSum(temporary, bytes, sums, sums, items, stream), "adding up");
}

#endif

}  // namespace cuda
}  // namespace beags
